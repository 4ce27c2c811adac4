"""Made-up scenes with known truth: what the demo and the synthetic suite photograph."""
