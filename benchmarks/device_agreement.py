"""Do CPU and GPU agree on a batch with a camera? Loss, gradient into the styles, a chunk of actions."""

import argparse
from pathlib import Path

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config

import lerobot_swr  # noqa: F401

INPUTS = {
    "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
    "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 96, 96)),
}
TINY = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1}


def results(device: str, meta: LeRobotDatasetMetadata, tiny: bool) -> dict[str, torch.Tensor]:
    """Numbers of the same policy and batch on a device, in float32."""
    options = {"chunk_size": 20, "n_action_steps": 8, "use_vae": False, "dropout": 0.0}
    options |= {"pretrained_backbone_weights": None, **(TINY if tiny else {})}
    torch.manual_seed(0)
    backbone = PreTrainedConfig.get_choice_class("act")(device="cpu", **options)
    config = make_policy_config("zbc", backbone=backbone, device="cpu", input_features=dict(INPUTS))
    policy = make_policy(config, ds_meta=meta).to(device)
    windows = resolve_delta_timestamps(config, meta)
    dataset = LeRobotDataset(meta.repo_id, root=meta.root, delta_timestamps=windows, video_backend="pyav")
    rows = torch.linspace(0, len(dataset) - 1, 8).long().tolist()
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
    batch = preprocessor(torch.utils.data.default_collate([dataset[row] for row in rows]))
    batch = {k: v.to(device) if torch.is_tensor(v) else v for k, v in batch.items()}
    policy.train()
    loss, _ = policy.forward(batch)
    loss.backward()
    gradient = policy.styles.embedding.weight.grad
    policy.eval()
    policy.reset()
    policy.styles.request([0])
    chunk = policy.predict_action_chunk(batch)
    return {"loss": loss.detach().cpu(), "gradient": gradient.cpu(), "chunk": chunk.cpu()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    meta = LeRobotDatasetMetadata("local/pusht", root=args.dataset)
    one, other = (results(device, meta, args.tiny) for device in ("cpu", args.device))
    for name, value in one.items():
        error = float((value - other[name]).norm() / value.norm())
        print(f"cpu and {args.device}, {name}: relative difference {error:.1e}", flush=True)
        if not error < 1e-3:
            raise SystemExit(f"{name} differs by {error:.1e} between cpu and {args.device}")


if __name__ == "__main__":
    main()
