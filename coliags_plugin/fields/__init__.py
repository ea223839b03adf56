"""Fields: trainable scene representations."""
