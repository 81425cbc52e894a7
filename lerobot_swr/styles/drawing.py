"""How styles are drawn for the episodes of an environment, of those that are allowed."""

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from lerobot_swr.styles.scenes import Scenes

StyleSampling = Literal["uniform", "stratified", "fixed", "scene"]
SAMPLINGS: tuple[StyleSampling, ...] = get_args(StyleSampling)


class StyleDrawing:
    """Draws one of the allowed styles for every episode, from torch's global generator.

    Args:
        sampling: ``uniform`` draws with replacement (eq. 2); ``stratified`` uses each allowed style once, in
            random order, before any is used again; ``fixed`` takes the allowed styles in their given order,
            over and over; ``scene`` takes one whose demonstration began most like the rollout does.
        scenes: How the demonstrations began, for ``scene``.
        near_scenes: Of how many that began most like the rollout ``scene`` draws one.

    Raises:
        ValueError: For an unknown way of sampling.
    """

    def __init__(self, sampling: StyleSampling, scenes: Scenes | None = None, near_scenes: int = 1):
        check_style_sampling(sampling)
        self.sampling, self.scenes, self.near_scenes = sampling, scenes, near_scenes
        self._queues: dict[str | None, list[int]] = {}

    def restart(self) -> None:
        """Begin anew where styles are drawn in turn: the next draws do not depend on earlier ones."""
        self._queues = {}

    def draw(
        self, allowed: Tensor, count: int, name: str | None = None, scene: Tensor | None = None
    ) -> Tensor:
        """(count,) int64 of the (M,) `allowed`.

        Args:
            allowed: Episodes whose styles may be drawn.
            count: Number of draws.
            name: Of the selection that allows them: each is drawn in turn for itself.
            scene: (count, c) normalised observations with which the episodes begin, for ``scene``.

        Raises:
            ValueError: If drawing by scene is asked for without scenes.
        """
        if self.sampling == "scene":
            if scene is None or self.scenes is None:
                raise ValueError("style_sampling='scene': this needs the observations rollouts begin with")
            return _one_of_each(self.scenes.near(scene, allowed, self.near_scenes))
        if self.sampling == "uniform":
            return allowed[torch.randint(len(allowed), (count,), device=allowed.device)]
        queue = self._queues.setdefault(name, [])
        while len(queue) < count:
            order = torch.arange(len(allowed)) if self.sampling == "fixed" else torch.randperm(len(allowed))
            queue += allowed.cpu()[order].tolist()
        self._queues[name] = queue[count:]
        return torch.tensor(queue[:count], device=allowed.device)


def _one_of_each(choices: Sequence[Tensor]) -> Tensor:
    """(B,) one of each of B tensors (M_b,), drawn uniformly."""
    places = [torch.randint(len(choice), (1,), device=choice.device) for choice in choices]
    return torch.cat([choice[place] for choice, place in zip(choices, places, strict=True)])


def check_style_sampling(sampling: str) -> StyleSampling:
    """The way of drawing styles of that name.

    Raises:
        ValueError: For anything but ``uniform``, ``stratified``, ``fixed`` and ``scene``.
    """
    for known in SAMPLINGS:
        if known == sampling:
            return known
    names = ", ".join(map(repr, SAMPLINGS[:-1]))
    raise ValueError(f"style_sampling={sampling!r}: expected {names} or {SAMPLINGS[-1]!r}")
