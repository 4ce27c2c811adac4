"""How alike photos look, told by their largest features all together: no two features are compared.

Features are sorted to a few words, which are found among the photos' own features, and what they differ from their
word by is summed up word by word [Jegou et al., Aggregating Local Descriptors into a Compact Image Representation,
CVPR 2010: VLAD]. Of two photos that show the same, these sums point the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int, UInt8

WORDS, ROUNDS = 256, 8
LEARNED_FROM = 40_000  # features of all photos that words are learned from
LEAST_LENGTH = 1e-6  # of a vector that is divided by its length


def signatures(descriptors: Sequence[UInt8[np.ndarray, "_ 128"]], seed: int = 0) -> Float[np.ndarray, "n d"]:
    """A unit vector for each photo's features, zero for one without any; near each other where photos look alike."""
    rng = np.random.default_rng(seed)
    each = -(-LEARNED_FROM // max(len(descriptors), 1))
    words = learn_words(_roots(np.concatenate([own[rng.permutation(len(own))[:each]] for own in descriptors])), rng)
    found = np.zeros((len(descriptors), words.size), np.float32)
    for signature, own in zip(found, descriptors, strict=True):
        if len(own):
            signature[:] = aggregate(_roots(own), words)
    return found


def learn_words(features: Float[np.ndarray, "m d"], rng: np.random.Generator) -> Float[np.ndarray, "w d"]:
    """Middles of up to `WORDS` clusters of features (k-means, begun at some of them)."""
    words = features[rng.permutation(len(features))[:WORDS]].copy()
    for _ in range(ROUNDS):
        nearest = nearest_words(features, words)
        for word in np.unique(nearest):
            words[word] = features[nearest == word].mean(axis=0)
    return words


def nearest_words(features: Float[np.ndarray, "m d"], words: Float[np.ndarray, "w d"]) -> Int[np.ndarray, " m"]:
    """The word at the least distance from each feature."""
    return (features @ words.T - (words**2).sum(1) / 2).argmax(1)


def aggregate(features: Float[np.ndarray, "m d"], words: Float[np.ndarray, "w d"]) -> Float[np.ndarray, " wd"]:
    """Sums of features less their word, for each word. Of roots, so that what is there many times counts less."""
    nearest, sums = nearest_words(features, words), np.zeros_like(words)
    np.add.at(sums, nearest, features - words[nearest])
    rooted = np.sign(sums) * np.sqrt(np.abs(sums))
    return (rooted / max(float(np.linalg.norm(rooted)), LEAST_LENGTH)).ravel()


def _roots(descriptors: UInt8[np.ndarray, "m d"]) -> Float[np.ndarray, "m d"]:
    """Unit vectors of the roots of descriptors, whose distances tell more [Arandjelovic and Zisserman, CVPR 2012]."""
    roots = np.sqrt(descriptors.astype(np.float32))
    return roots / np.maximum(np.linalg.norm(roots, axis=1, keepdims=True), LEAST_LENGTH)
