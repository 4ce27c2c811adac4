"""Cameras, similarities and the normalised frame. Pure NumPy.

Shapes are in the types: `Float[np.ndarray, "n 3"]`, one letter one length within a signature or a record. They are for
readers and for the tests, which check them (`pytest --check-shapes`); the product does not import `jaxtyping`.
"""
