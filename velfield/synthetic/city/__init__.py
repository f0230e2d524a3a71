"""The simulated city: streets, blocks, ground, relief."""
