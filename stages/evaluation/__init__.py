"""How good a result is: surfaces against a truth, benchmarks' own protocols, drawings against photos.

Arrays in, numbers out; files are read by `stages.evaluation.reading`.
"""
