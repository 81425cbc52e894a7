"""The style cookbook: one trainable style z per demonstration, and how styles are drawn at inference."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_swr.styles.drawing import StyleDrawing, StyleSampling
from lerobot_swr.styles.embedding import MannerEmbedding
from lerobot_swr.styles.request import BLENDED, StyleRequest, Styles, as_request, check_request
from lerobot_swr.styles.scenes import Scenes
from lerobot_swr.styles.selection import ResolvedSelection, StyleSelection
from lerobot_swr.styles.table import StyleTable
from lerobot_swr.trajectories import Trajectories


class StyleCookbook(nn.Module):
    """Styles {z_i} of a dataset's episodes.

    Attributes:
        embedding: `nn.Embedding` with one row per episode, (N, style_dim).
        trained: (N,) uint8 buffer, 1 where the episode takes part in training, from the first step on (or
            was encoded); only those styles are ever drawn.
        active: (B,) int64, the episodes whose styles the current rollout uses, `BLENDED` for a blend; None
            before its first action.
        table: What is known of each demonstration; None where the checkpoint has no table.
        selection: Which styles may be drawn.
        drawing: How they are drawn.
        scenes: How each demonstration began.
        embedded: What gives demonstrations their styles; None where they start at random.
        asked: What rollouts use instead: styles, or a selection to draw from; None for neither.

    Args:
        num_episodes: N.
        style_dim: Dimension of z.
        init_scale: Standard deviation of the normal initialisation.
        sampling: How they are drawn; see `StyleDrawing`.
        selection: Which styles may be drawn; by default all that were trained.
        scene_dim: Dimensions of an observation, for ``scene``.
        near_scenes: As in `StyleDrawing`.

    Raises:
        ValueError: For an unknown way of sampling, or a selection that is empty or out of range.
    """

    def __init__(
        self,
        num_episodes: int,
        style_dim: int,
        init_scale: float,
        sampling: StyleSampling = "uniform",
        selection: StyleSelection | None = None,
        scene_dim: int = 0,
        near_scenes: int = 1,
    ):
        super().__init__()
        self.scenes = Scenes(num_episodes, scene_dim)
        self.drawing = StyleDrawing(sampling, self.scenes, near_scenes)
        self.embedding = nn.Embedding(num_episodes, style_dim)
        nn.init.normal_(self.embedding.weight, std=init_scale)
        self.embedded: MannerEmbedding | None = None
        self.trained: Tensor
        self.register_buffer("trained", torch.zeros(num_episodes, dtype=torch.uint8))
        self.table: StyleTable | None = None
        self.active: Tensor | None = None
        self._acting = torch.empty(0)  # (B, style_dim) the active styles; another tensor when they change
        self._resolved: ResolvedSelection | None = None
        self._names: list[str | None] = []
        self._change = False
        self.asked: StyleRequest | StyleSelection | None = None
        self.restrict(selection or StyleSelection())

    def __len__(self) -> int:
        """Number of episodes, trained or not."""
        return self.embedding.num_embeddings

    def forward(self, episodes: Tensor) -> Tensor:
        """(B, style_dim) styles of the (B,) `episodes`, to be trained."""
        weight = self.embedding.weight
        # To an optimizer that says so, and keeps a block for the gradient, go few rows instead of all.
        sparse = getattr(weight, "by_rows", False) and weight.grad is not None
        return nn.functional.embedding(episodes, weight, sparse=sparse)

    def check_trained(self, episodes: Tensor) -> None:
        """Refuse frames of episodes that do not take part in training.

        Raises:
            ValueError: Naming them.
        """
        if not self.trained[episodes].all():
            others = episodes[self.trained[episodes] == 0].unique().tolist()
            raise ValueError(
                f"a batch holds frames of episodes {others}, which the policy was not made to train on: name "
                "them in --dataset.episodes or, in Python, create the policy within run_context.running(...)"
            )

    def embed(self, embedding: MannerEmbedding, compared: Trajectories | None) -> None:
        """Let styles be coordinates of what ν compares of the demonstrations; None: they are to be loaded."""
        self.embedded = embedding
        if compared is not None:
            with torch.no_grad():
                self.embedding.weight.copy_(embedding.of(compared))

    # --- Choosing styles ---

    def filter(self, text: str) -> list[int]:
        """The episodes that match a filter and have a style, e.g. ``"70 <= length <= 80"``.

        Raises:
            ValueError: If there are none, the filter is none, or the checkpoint has no table.
        """
        return StyleSelection(filter=text).resolve(self._is_trained(), self.table)

    def select(self, episodes: Sequence[int] | None) -> None:
        """From the next rollout on draw these episodes' styles only; None allows all again.

        Raises:
            ValueError: If the selection is empty, or an episode does not exist.
        """
        self.restrict(StyleSelection(episodes=episodes))

    def restrict(self, selection: StyleSelection) -> None:
        """From the next rollout on draw only the styles of a selection.

        Raises:
            ValueError: If an episode of the selection does not exist.
        """
        selection.check_episodes(len(self))
        self.selection, self.asked, self._change = selection, None, False
        self.restart()

    def restart(self) -> None:
        """Begin anew where styles are taken in turn: the next rollouts do not depend on earlier ones."""
        self.drawing.restart()
        self._taken = 0

    def interpolate(self, i: int, j: int, share: float) -> None:
        """From the next rollout on use the blend (1 − share) z_i + share z_j, until `select` or `restrict`.

        Raises:
            ValueError: If an episode has no style, or the share is outside 0 to 1.
        """
        check_request(StyleRequest((i, j)), self._is_trained(), None, self.embedding.embedding_dim)
        if not 0 <= share <= 1:
            raise ValueError(f"style_interpolate=[{i}, {j}, {share}]: the share must lie in 0 to 1")
        start, end = self.embedding.weight.detach()[[i, j]]
        self.asked = StyleRequest(vectors=torch.lerp(start, end, share)[None])

    def request(self, styles: Styles) -> None:
        """From the next step on act by these styles, in the rollout under way and in those that follow.

        Policies that plan several actions at once take the styles at their next plan.

        Args:
            styles: An episode, or several that the environments take in turn; (K, style_dim) vectors, taken
                in turn; the name of a filter of the table, a filter or a selection, to draw from; None goes
                back to what is drawn without a request, from the next rollout on.

        Raises:
            ValueError: If an episode has no style, nothing matches, or the text is no filter.
        """
        asked = as_request(styles, {} if self.table is None else self.table.filters)
        if asked is not None:
            check_request(asked, self._is_trained(), self.table, self.embedding.embedding_dim)
        self.asked, self._change = asked, asked is not None
        self.restart()

    @contextmanager
    def requested(self, request: StyleRequest) -> Iterator[None]:
        """Within the block, from the next rollout on, use the styles of a request, in order.

        Raises:
            ValueError: If an episode has no style.
        """
        check_request(request, self._is_trained(), self.table, self.embedding.embedding_dim)
        before, self.asked = self.asked, request
        self.restart()
        try:
            yield
        finally:
            self.asked = before
            self.restart()

    def allowed(self, name: str | None = None) -> Tensor:
        """(M,) int64, the episodes whose styles may be drawn, also by the table's filter called `name`.

        Raises:
            ValueError: If there are none, or a selected style was not trained.
        """
        selection = self.asked if isinstance(self.asked, StyleSelection) else self.selection
        known = self._resolved
        if known is None or not known.holds(selection, self.table, self.trained):
            self._resolved = known = ResolvedSelection(selection, self.table, self.trained.clone())
        return known.allowed(name)

    def _is_trained(self) -> np.ndarray:
        return self.trained.bool().cpu().numpy()

    # --- Drawing styles ---

    def draw(self, batch_size: int, tasks: Sequence[str] = (), scene: Tensor | None = None) -> Tensor:
        """Draw the styles of `batch_size` episodes from torch's global generator: (B,) int64, by episode.

        Args:
            batch_size: B.
            tasks: One task string per episode; one that is the name of a filter of the table restricts the
                draw to it. Empty for none.
            scene: (B, scene_dim) normalised observations with which the episodes begin; only drawing by scene
                needs them.

        Raises:
            ValueError: If drawing by scene is asked for without scenes.
        """
        return self._draw_each(self._filter_names(batch_size, tasks), self.allowed, scene)

    def _filter_names(self, batch_size: int, tasks: Sequence[str]) -> list[str | None]:
        """The named filter that each environment's task string is, if it is one."""
        if self.table is None or self.asked is not None:  # a request stands above tasks
            return [None] * batch_size
        return [task if task in self.table.filters else None for task in tasks] or [None] * batch_size

    def _draw_each(
        self, names: Sequence[str | None], allowed: Callable[[str | None], Tensor], scene: Tensor | None
    ) -> Tensor:
        """(B,) int64 of the (M,) that are `allowed` to each of B names, for the (B, c) scenes."""
        drawn = torch.empty(len(names), dtype=torch.int64, device=self.trained.device)
        for name in dict.fromkeys(names):
            places = [place for place, other in enumerate(names) if other == name]
            begun = None if scene is None else scene[places]
            drawn[places] = self.drawing.draw(allowed(name), len(places), name, begun)
        return drawn

    # --- Rollouts ---

    def end_rollout(self) -> None:
        """Forget the active styles; the next action draws new ones, by scene for what is seen then."""
        self.active = None

    def active_styles(
        self, batch_size: int, tasks: Sequence[str] = (), scene: Tensor | None = None
    ) -> Tensor:
        """(B, style_dim) styles of the rollout under way, drawn at its first action and kept to its end.

        They stay as they were then, and change by a request, or where a task string names another filter.

        Args:
            batch_size: B.
            tasks: As in `draw`.
            scene: As in `draw`.

        Raises:
            ValueError: If the batch size changes within a rollout.
        """
        if self.active is None:
            self.active, self._acting = self._next(batch_size, tasks, scene)
            self._names, self._change = self._filter_names(batch_size, tasks), False
        if len(self.active) != batch_size:
            raise ValueError(
                f"batch of {batch_size} observations in a rollout of {len(self.active)} environments: "
                "call policy.reset() before a rollout with another number of environments"
            )
        self._follow(batch_size, tasks, scene)
        return self._acting

    def _follow(self, batch_size: int, tasks: Sequence[str], scene: Tensor | None) -> None:
        """Change the active styles where a request or a task string says so since the last step."""
        assert self.active is not None
        if self._change:
            self.active, self._acting = self._next(batch_size, tasks, scene)
            self._change = False
        elif self.asked is None:
            names = self._filter_names(batch_size, tasks)
            new = [k for k, name in enumerate(names) if name is not None and name != self._names[k]]
            if new:
                drawn = self.draw(len(new), [tasks[k] for k in new], None if scene is None else scene[new])
                place = torch.tensor(new, device=drawn.device)
                self.active = self.active.index_copy(0, place, drawn)
                self._acting = self._acting.index_copy(0, place, self.embedding.weight.detach()[drawn])
            self._names = names

    def _next(self, batch_size: int, tasks: Sequence[str], scene: Tensor | None) -> tuple[Tensor, Tensor]:
        """(B,) episodes for a rollout, `BLENDED` where a style is no episode's, and (B, style_dim) styles."""
        asked = self.asked
        if asked is None or isinstance(asked, StyleSelection):
            episodes = self.draw(batch_size, tasks, scene)
        else:
            places, device = asked.places(self._taken, batch_size), self.trained.device
            self._taken += batch_size
            if asked.vectors is not None:
                blended = torch.full((batch_size,), BLENDED, device=device)
                return blended, asked.vectors.to(self.embedding.weight)[places]
            if asked.choices is None:
                episodes = torch.tensor(asked.episodes, device=device)[places]
            else:
                of = {f"choice {k}": torch.tensor(c, device=device) for k, c in enumerate(asked.choices)}
                names = [f"choice {k}" for k in places.tolist()]
                episodes = self._draw_each(names, lambda name: of[str(name)], scene)
        return episodes, self.embedding.weight.detach()[episodes]
