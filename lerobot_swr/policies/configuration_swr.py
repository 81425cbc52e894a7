"""Configurations of the policies ``bc``, ``zbc`` and ``wzbc``.

The method is that of *Offline Learning of Controllable Diverse Behaviors* (Petitbois, Portelas, Lamprier,
Denoyer; arXiv 2504.18160), "the paper". Defaults are the paper's values, except where a comment says
otherwise; `docs/method.md` gives the reasons and the flags of the paper's literal network.
"""

from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.policies.backbones.style_place import AUTO, check_style_place
from lerobot_swr.policies.backed_config import BackedConfig
from lerobot_swr.sampling import check_partner_sampling, check_probability
from lerobot_swr.similarity import Manner, check_beta, check_normalization
from lerobot_swr.styles.drawing import check_style_sampling
from lerobot_swr.styles.selection import StyleSelection


@PreTrainedConfig.register_subclass("bc")
@dataclass
class BCConfig(BackedConfig):
    """Behaviour cloning with a deterministic policy: the baseline without styles."""


@PreTrainedConfig.register_subclass("zbc")
@dataclass
class ZBCConfig(BCConfig):
    """Style-conditioned behaviour cloning: one trainable style per demonstration (eq. 1 and 2)."""

    takes_style: ClassVar[bool] = True

    # --- Styles ---
    # Dimension of a style z; null chooses by how much scenes vary.
    style_dim: int | None = 10
    # Where styles start: "normal" (at random) or "similarity" (principal coordinates of what similarity
    # compares, the first with a standard deviation of 1). For scenes that vary, see docs/scenes.md.
    style_init: str = "normal"
    # Standard deviation of noise on the styles in training; null takes 0.1 for style_init=similarity, else 0.
    style_noise: float | None = None
    # Standard deviation of the styles' normal initialisation. The paper's code leaves PyTorch's 1.0, which
    # needs several times more steps.
    style_init_scale: float = 0.1
    # Learning rate of the styles, in units of optimizer_lr; null takes 5 for mlp, as a style learns from its
    # own episode alone and with the paper's 1 lags behind the network, and 0 for style_init=similarity,
    # whose styles then stay as they are.
    style_lr_scale: float | None = None
    # Learning rate of the styles; null takes style_lr_scale times optimizer_lr for mlp, 0.005 for other
    # backbones, whose presets range from 1e-5 to 1e-3. Weight decay is 0 on styles.
    style_lr: float | None = None
    # Which observation of a LeRobot policy the style extends: "environment_state", "state", or "auto", the
    # first of them through which it reaches the network. mlp does not need it.
    style_key: str = AUTO

    # --- Similarity of demonstrations ---
    # Features of numbers, in their own units, over which demonstrations are compared; null takes all
    # observations that the network sees. Any column of the dataset will do, seen by the network or not.
    similarity_keys: list[str] | None = None
    # Compare the hand's path in the frame of this object instead (and the similarity_keys that are named).
    similarity_frame: str | None = None
    # How far from the object that path saturates, in units of its position.
    similarity_scale: float = 0.1
    # Compare what a function tells of an episode instead: module:function, {feature: (T, d)} -> (k,) or
    # (T, k).
    similarity_features: str | None = None

    # --- Corrective labels: beyond the paper, see docs/contracting.md ---
    # Teach every style the way back to its demonstration, from states beside it: "none" (the paper), "noise"
    # (its own states with noise; for states of few dimensions) or "demos" (states of other demonstrations,
    # and noise where none is near).
    corrective: str = "none"
    # How far beside: the largest noise, or the distance at which other demonstrations' states become rare, as
    # a share of each state dimension's range, in a state of two dimensions; √(2 / d) times that in one of d,
    # if d > 2. More is more robust and keeps the timing less well.
    corrective_scale: float = 0.1
    # Steps in which a corrective action leads back; null takes them from the data.
    corrective_horizon: int | None = None
    # Whether actions are targets of the state, to be learned relative to it; null asks the data.
    corrective_relative: bool | None = None

    # --- Inference: which styles are drawn, one per episode of the environment ---
    # "uniform" (with replacement, the paper), "stratified" (each style once before any is used again),
    # "fixed" (in the given order) or "scene" (one whose demonstration began most like the rollout); null
    # chooses by how much scenes vary.
    style_sampling: str | None = "uniform"
    # Only the styles of these episodes of the training dataset; null allows all that were trained.
    style_episodes: list[int] | None = None
    # Only the styles of demonstrations that match a filter, e.g. "70 <= length <= 80 and behavior == '6410'";
    # lerobot-swr-styles CHECKPOINT lists the names. This and the conditions before and after must all hold.
    style_filter: str | None = None
    # Only the styles of this episode and of those nearest to it by dissimilarity.
    style_like: int | None = None
    # How many of the nearest others style_like allows, null for 5; without style_like, how many of those that
    # began most like the rollout style_sampling=scene draws from, null for 1.
    style_neighbours: int | None = None
    # [i, j, share]: every rollout uses the blend (1 - share) z_i + share z_j of two episodes' styles.
    style_interpolate: list[float] | None = None

    # --- The demonstrations' table, made when the policy is created with its dataset ---
    # Labels demonstrations in the column "behavior": module:function, or behaviors.json as
    # lerobot-swr-behaviors finds them. null takes the rule of this package's own datasets; other datasets
    # then have no such column.
    behavior_rule: str | None = None
    # Further columns: module:function, whose name the column has, or a .json or .csv file with values of
    # every episode; several are separated by commas.
    style_metrics: str | None = None

    # --- Set from the dataset by corrective labels; not meant to be given ---
    # Steps in which a corrective action leads back.
    inverse_horizon: int | None = None
    # Held-out R² of the inverse model for each action dimension; below 0.8 it is not corrected.
    inverse_r2: list[float] | None = None
    # State dimension whose target each action dimension is, -1 for none; the network then predicts actions
    # relative to the state.
    action_targets: list[int] | None = None

    # --- Set from the dataset by style_init=similarity; not meant to be given ---
    # Frames and dimensions of what is compared.
    embedded_shape: tuple[int, int] | None = None

    # --- Set by lerobot-swr-styles --add; not meant to be given ---
    # Number of styles that were encoded for episodes of other datasets, after those of the training dataset.
    num_added_styles: int = 0

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        super().__post_init__()
        if self.style_dim is not None and self.style_dim < 1:
            raise ValueError(f"style_dim={self.style_dim}: expected at least 1")
        if not self.style_init_scale >= 0:
            raise ValueError(f"style_init_scale={self.style_init_scale}: expected a number >= 0")
        self._settle_style_init()
        if self.style_lr is not None and not self.style_lr > 0:
            raise ValueError(f"style_lr={self.style_lr}: expected a number > 0")
        check_style_place(self.style_key)
        if self.style_sampling is not None:
            check_style_sampling(self.style_sampling)
        if self.corrective not in ("none", "noise", "demos"):
            raise ValueError(f"corrective={self.corrective!r}: expected 'none', 'noise' or 'demos'")
        if not self.corrective_scale > 0:
            raise ValueError(f"corrective_scale={self.corrective_scale}: expected a number > 0, e.g. 0.1")
        selection = self.style_selection
        if self.style_interpolate is not None:
            if len(self.style_interpolate) != 3 or any(i != int(i) for i in self.style_interpolate[:2]):
                raise ValueError(
                    f"style_interpolate={self.style_interpolate}: expected [i, j, share], two episodes and a "
                    "share from 0 to 1"
                )
            if selection != StyleSelection(neighbours=selection.neighbours):
                raise ValueError(
                    f"style_interpolate={self.style_interpolate} fixes the style: leave out style_episodes, "
                    "style_filter and style_like"
                )

    def _settle_style_init(self) -> None:
        """Check how styles start, and fill in what depends on it."""
        if self.style_init not in ("normal", "similarity"):
            raise ValueError(f"style_init={self.style_init!r}: expected 'normal' or 'similarity'")
        embedded = self.style_init == "similarity"
        if self.style_noise is None:
            self.style_noise = 0.1 if embedded else 0.0
        scale = self.style_lr_scale
        if scale is not None and not (scale > 0 or (embedded and scale == 0)):
            raise ValueError(
                f"style_lr_scale={self.style_lr_scale}: expected a number > 0; the paper uses 1, and "
                "style_init=similarity may do with 0"
            )
        if not self.style_noise >= 0:
            raise ValueError(f"style_noise={self.style_noise}: expected a number >= 0")
        if not self.similarity_scale > 0:
            raise ValueError(f"similarity_scale={self.similarity_scale}: expected a number > 0, e.g. 0.1")
        if self.similarity_features is not None and (self.similarity_frame or self.similarity_keys):
            raise ValueError(
                f"similarity_features={self.similarity_features!r} says all that is compared: leave out "
                "similarity_frame and similarity_keys"
            )

    @property
    def compared_keys(self) -> list[str]:
        """The features over which ν compares demonstrations."""
        return self.similarity_keys or self.observation_keys

    @property
    def manner(self) -> Manner:
        """What of demonstrations ν compares."""
        is_plain = self.similarity_frame is None and self.similarity_features is None
        keys = self.compared_keys if is_plain or self.similarity_keys else []
        names = self.dimension_names or {}
        return Manner(
            tuple(keys), self.similarity_frame, self.similarity_scale, names, self.similarity_features
        )

    @property
    def looks_for_things(self) -> bool:
        """Whether an option needs the names of the observation's dimensions."""
        return super().looks_for_things or self.similarity_frame is not None

    @property
    def has_fixed_styles(self) -> bool:
        """Whether styles stay as they were made."""
        is_left_open = self.style_lr_scale is None and self.style_lr is None
        return self.style_lr_scale == 0 or (is_left_open and self.style_init == "similarity")

    @property
    def styles_lr(self) -> float:
        """Learning rate of the styles."""
        return self.traits.style_lr(self) if self.style_lr is None else self.style_lr

    @property
    def style_selection(self) -> StyleSelection:
        """Which styles may be drawn."""
        neighbours = 5 if self.style_neighbours is None else self.style_neighbours
        return StyleSelection(self.style_episodes, self.style_filter, self.style_like, neighbours)

    @property
    def near_scenes(self) -> int:
        """Of how many styles that began most like the rollout one is drawn by scene."""
        return 1 if self.style_like is not None else max(1, self.style_neighbours or 1)


@PreTrainedConfig.register_subclass("wzbc")
@dataclass
class WZBCConfig(ZBCConfig):
    """ZBC with similarity weighted regression: algorithm 1.

    Similar demonstrations teach each other's styles.
    """

    # --- Similarity weighted regression ---
    # Inverse temperature of the weights exp(-beta * nu): 0 lets every demonstration teach every style, large
    # values only (near-)equal ones. null chooses by how much scenes vary.
    beta: float | None = 10.0
    # Probability with which algorithm 1 relabels a frame with another demonstration's style; 0 is ZBC.
    p: float = 0.8
    # Draw pairs by their share in the expected loss ("weighted"), or partners uniformly with the loss
    # weighted ("uniform", the paper: same expectation, but a share p of the batch teaches almost nothing).
    partner_sampling: str = "weighted"
    # Divide distances by the farthest episode of each demonstration ("row", the paper) or of all ("global").
    similarity_normalization: str = "row"

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        super().__post_init__()
        if self.beta is not None:
            check_beta(self.beta)
        check_probability(self.p)
        check_partner_sampling(self.partner_sampling)
        check_normalization(self.similarity_normalization)
