"""The parts of diffusers, which only the baselines need: imported here, to explain once if it is missing."""

from lerobot_swr.installation import MissingExtraError

try:
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
    from diffusers.schedulers.scheduling_euler_ancestral_discrete import EulerAncestralDiscreteScheduler
    from diffusers.utils.torch_utils import randn_tensor
except ModuleNotFoundError as error:
    raise MissingExtraError("each of the policies ddpm_gpt, ddpm_act and beso", "baselines", error) from error

__all__ = ["DDPMScheduler", "EulerAncestralDiscreteScheduler", "randn_tensor"]
