"""How surfaces are scored, a protocol a file: what it measures, how its truth is read, what `hineus evaluate` says."""
