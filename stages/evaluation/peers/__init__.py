"""Other methods on the same photos and poses."""
