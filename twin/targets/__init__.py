"""Camera images of test targets, and measurements in them."""
