"""How a style policy is kept: in checkpoints, on the Hub, as adapters of a checkpoint."""

from pathlib import Path
from typing import Any, Self, cast

from lerobot.configs.train import TrainPipelineConfig
from torch import Tensor, nn

from lerobot_swr.corrective.relative_actions import RelativeActions
from lerobot_swr.policies import style_checkpoints
from lerobot_swr.policies.backbones.backbone import Backbone
from lerobot_swr.policies.checked_loading import CheckedLoading
from lerobot_swr.policies.configuration_swr import BCConfig, ZBCConfig
from lerobot_swr.policies.lessons import Correct
from lerobot_swr.policies.training_data import TrainingData
from lerobot_swr.sharing.policy_card import upload_beside, write_policy_card
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.table import load_style_table

HUB_OPTIONS = ("revision", "token", "cache_dir", "local_files_only", "force_download")
STYLES = "styles.embedding"  # what adapters (PEFT) do not replace, but train whole


class StoredStyles(CheckedLoading):
    """For a style policy, before `PreTrainedPolicy` among its bases; `StylePolicy` has the attributes."""

    config: BCConfig
    backbone: Backbone
    styles: StyleCookbook
    has_styles: bool
    relative: RelativeActions | None
    correct: Correct | None
    data: TrainingData | None

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **kwargs: Any) -> Self:  # type: ignore[override]
        """Load a checkpoint and its table of demonstrations; selections of styles are checked at once.

        Raises:
            ValueError: If the checkpoint is damaged, or the selection of styles is empty.
        """
        policy = super().from_pretrained(pretrained_name_or_path, **kwargs)  # type: ignore[misc]
        if policy.has_styles:
            options = {key: kwargs[key] for key in HUB_OPTIONS if key in kwargs}
            style_checkpoints.adopt_table(
                policy.styles, load_style_table(pretrained_name_or_path, **options), policy.data
            )
            if policy.data is None:  # in training, styles to draw need not exist yet
                style_checkpoints.select_styles(policy.styles, cast(ZBCConfig, policy.config))
        return policy

    def push_model_to_hub(self, cfg: TrainPipelineConfig, *args: Any, **kwargs: Any) -> None:
        """As LeRobot does, and table and picture of the styles, whose kinds of files LeRobot leaves out."""
        upload_beside(self)
        # Last, because a remote run ends when it says that the model is there.
        super().push_model_to_hub(cfg, *args, **kwargs)  # type: ignore[misc]

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        super()._save_pretrained(save_directory, state_dict)  # type: ignore[misc]
        if self.has_styles and self.styles.table is not None:
            self.styles.table.save(Path(save_directory))
        write_policy_card(self, Path(save_directory))

    def adapted(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """What of a checkpoint's tensors is to be loaded: on another dataset, new styles are started.

        Raises:
            ValueError: If corrective labels are asked of a checkpoint that was trained without, to act.
        """
        if self.correct is not None and self.data is None:
            style_checkpoints.check_corrective(cast(ZBCConfig, self.config).corrective, state)
        state = style_checkpoints.with_own_draws(cast(nn.Module, self), state, self.data)
        if self.data is not None:
            state = {**state, **{f"backbone.{key}": value for key, value in self.backbone.units.items()}}
        if self.data is not None and self.relative is not None:  # computed from the dataset
            own = self.relative.state_dict().items()
            state = {**state, **{f"relative.{key}": value for key, value in own}}
        return style_checkpoints.with_own_styles(self.styles, state, self.data) if self.has_styles else state

    # --- Adapters ---

    def _get_default_peft_targets(self) -> dict[str, Any] | None:
        """The backbone's modules that adapters are put on, and the styles, which are trained whole."""
        targets = self.backbone.peft_targets() or {}
        whole = [STYLES] if self.has_styles else []
        return {**targets, "modules_to_save": [*(targets.get("modules_to_save") or []), *whole]}

    def _preprocess_peft_cli_overrides(self, cli_overrides: dict, peft_method_type: Any) -> dict:
        """As LeRobot does; modules that the command names to be trained whole come beside the styles."""
        options = super()._preprocess_peft_cli_overrides(cli_overrides, peft_method_type)  # type: ignore[misc]
        if options.get("modules_to_save") is not None and self.has_styles:
            options["modules_to_save"] = [*options["modules_to_save"], STYLES]
        return options

    def _validate_peft_config(self, peft_config: Any) -> None:
        """Refuse what could not be loaded again.

        Raises:
            ValueError: Without a checkpoint with styles of the same dataset to begin from.
        """
        super()._validate_peft_config(peft_config)  # type: ignore[misc]
        if self.data is not None and self.data.fine_tunes:
            raise ValueError(
                f"peft: the adapters' checkpoint would keep the styles of {self.config.pretrained_path}, "
                f"which are not those of dataset.root={str(self.data.root)!r}; fine-tune without adapters"
            )

    def _refuse_untrained_styles(self) -> None:
        """Refuse to act with styles that a checkpoint of other data does not know.

        Raises:
            ValueError: Naming the dataset.
        """
        if self.data is not None and self.data.fine_tunes:
            raise ValueError(
                f"this policy was created to be trained on {self.data.root}, which is not the dataset of "
                f"its checkpoint, so its {len(self.styles)} styles are new; to act with the checkpoint's, "
                "load it without dataset_meta (ds_meta), whatever dataset you evaluate on"
            )
