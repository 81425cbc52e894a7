"""How alike demonstrations are: dissimilarities ν and weights W, for any number of episodes.

* `distances`: the definition, of all pairs at once (N × N, float64), ν and W.
* `measure`: what callers ask, `Similarity`: distances of given pairs, the farthest and the nearest episodes;
  and who answers, by the definition's matrix up to a few thousand episodes, without any matrix beyond.
* `vectors`: episodes as padded vectors, and the distances of given pairs of them.
* `sketch`: few numbers for each of these vectors, with bounds of what they leave out.
* `neighbours`: the farthest and the nearest of many episodes, found by sketches and measured by vectors.
* `cache`: what was found, kept beside the dataset.
* `manner`: what of a demonstration is compared: its states, the hand's path about an object, or features.

Training, pictures, the table of styles and the evaluations ask here; nobody else computes ν or W.
"""

from lerobot_swr.similarity.distances import (
    Normalization,
    check_beta,
    check_normalization,
    similarity_weights,
)
from lerobot_swr.similarity.manner import Manner
from lerobot_swr.similarity.measure import Dissimilarity, Similarity, similarity_by, similarity_of

__all__ = [
    "Dissimilarity",
    "Manner",
    "Normalization",
    "Similarity",
    "check_beta",
    "check_normalization",
    "similarity_by",
    "similarity_of",
    "similarity_weights",
]
