"""Made-up captures of the kinds that people take: what is meant, what stands around it, and where the photos are from.

Cameras and surfaces are exact; sparse points are simulated (`tracks`), so that a capture takes a second, or the photos
are rendered (`photos`) and the whole pipeline is run on them. Frame: metres, z up.
"""
