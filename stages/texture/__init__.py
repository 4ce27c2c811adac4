"""What is painted on a shape: charts, photos on them, relief, and how well it is known. No stage, no path."""
