"""What the user touches: commands, console, progress. No science."""
