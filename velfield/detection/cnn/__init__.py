"""The convolutional network: model, inference, training."""
