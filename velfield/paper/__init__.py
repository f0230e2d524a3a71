"""The paper's detector: dense response of boosted rectangle features, region growing."""
