"""The convolutional network: model, inference, training, self-training from motion."""
