"""The parts of diffusers, which only the baselines need: imported here, to explain once if it is missing."""

try:
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
    from diffusers.schedulers.scheduling_euler_ancestral_discrete import EulerAncestralDiscreteScheduler
    from diffusers.utils.torch_utils import randn_tensor
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"the policies ddpm_gpt, ddpm_act and beso need the package {error.name!r}: "
        "run pip install 'lerobot_policy_swr[baselines]'",
        name=error.name,
    ) from error

__all__ = ["DDPMScheduler", "EulerAncestralDiscreteScheduler", "randn_tensor"]
