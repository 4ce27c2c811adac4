"""Photos that nothing was learned from, against drawings of the result."""
