"""``wzbc``: similar demonstrations teach each other's styles."""

from collections.abc import Sequence
from typing import Any

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_swr.policies.configuration_swr import WZBCConfig
from lerobot_swr.policies.zbc_policy import ZBCPolicy
from lerobot_swr.sampling import SimilarityWeightedSampler, StepGenerator


class WZBCPolicy(ZBCPolicy):
    """ZBC with similarity weighted regression (WZBC): similar demonstrations teach each other's styles.

    With probability p a frame of τ_i is relabelled with the style z_j of another demonstration; its loss is
    weighted by W(τ_i, τ_j) and sends no gradient into z_j (algorithm 1). The pairs are drawn here, in
    `forward`, because LeRobot's frame sampler belongs to its training loop.

    Raises:
        ValueError: In addition to `ZBCPolicy`, if the dataset has a single episode.
    """

    config_class = WZBCConfig
    name = "wzbc"
    config: WZBCConfig

    def __init__(self, config: WZBCConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **kwargs: Any):
        super().__init__(config, dataset_meta, **kwargs)
        self.draws = StepGenerator()
        self.sampler: SimilarityWeightedSampler | None = None
        if dataset_meta is not None:
            if len(self.styles) < 2:
                raise ValueError(
                    f"dataset.root={str(dataset_meta.root)!r} has a single episode; wzbc compares episodes "
                    "and needs at least 2: record more, or use --policy.type=zbc"
                )
            self.sampler = SimilarityWeightedSampler(
                self.distances(),
                config.beta,
                config.p,
                config.similarity_normalization,  # type: ignore[arg-type]
                config.partner_sampling,  # type: ignore[arg-type]
            )

    def compared_keys(self) -> Sequence[str]:
        """The features over which ν compares demonstrations.

        Raises:
            ValueError: If a configured feature is unknown.
        """
        keys = self.config.similarity_keys or self.config.observation_keys
        known = [*self.config.observation_keys, ACTION]
        unknown = [key for key in keys if key not in known]
        if unknown:
            raise ValueError(f"similarity_keys={keys}: {unknown} are not among {known}")
        return keys

    def _relabel(self, drawn: dict[str, Tensor], steps: int) -> dict[str, Tensor]:
        """Draw the pair of each frame, corrective ones too: its style may be another episode's.

        ``relabelled`` (B,) is True where it is. The mean loss has algorithm 1's expectation.

        Raises:
            RuntimeError: If the policy was created without a dataset.
        """
        if self.sampler is None:
            raise RuntimeError("wzbc compares demonstrations to train: create the policy with dataset_meta")
        self.sampler.set_candidates(self.styles.trained[: self.config.num_episodes])
        episodes = drawn["style_episode"]
        pairs = self.sampler.draw(episodes, self.draws.uniforms(steps, len(episodes) // steps))
        weight = drawn["weight"] * pairs.weights
        return {**drawn, "weight": weight, "style_episode": pairs.styles, "relabelled": pairs.relabelled}

    def _drawn_styles(self, drawn: dict[str, Tensor]) -> Tensor:
        """(B, style_dim) styles; relabelled ones send no gradient into the cookbook (algorithm 1)."""
        style = super()._drawn_styles(drawn)
        if "relabelled" not in drawn:
            return style
        return torch.where(drawn["relabelled"].unsqueeze(-1), style.detach(), style)

    def figures(self, drawn: dict[str, Tensor], losses: Tensor) -> dict[str, float]:
        """Figures to log.

        ``own_style_loss``: the mean squared error of frames under their own style; ``relabelled_loss``: the
        mean of W(τ_i, τ_j) times the error under another style; ``mean_weight``: the mean of W(τ_i, τ_j);
        ``effective_demos`` per style. The first three count every episode alike where the loss does, and are
        unbiased estimates, whichever way pairs are drawn: the loss is (1 - p) own_style_loss + p
        relabelled_loss. They are defined for every batch: read their averages over time. Corrective frames
        count for ``corrective_loss`` alone, pair weights included: the loss is then half of the above plus
        half of it.
        """
        assert self.sampler is not None
        p = self.config.p
        figures = {"effective_demos": self.sampler.effective_demos, **super().figures(drawn, losses)}
        # NumPy: torch's overhead for so few numbers would be noticeable in every step.
        values, weights = losses.cpu().numpy(), drawn["weight"].cpu().numpy()
        relabelled = drawn["relabelled"].cpu().numpy()
        own, share = ~relabelled, float(len(values))
        if "corrective" in drawn:
            demonstrated = ~drawn["corrective"].cpu().numpy()
            own, relabelled, share = own & demonstrated, relabelled & demonstrated, share / 2
        if p < 1:
            figures["own_style_loss"] = float(values @ own) / share / (1 - p)
        if p > 0:
            figures["relabelled_loss"] = float(values @ relabelled) / share / p
            figures["mean_weight"] = float(weights @ relabelled) / share / p
        return figures
