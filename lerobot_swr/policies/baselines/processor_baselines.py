"""Pre- and post-processing of ``ddpm_gpt``, ``ddpm_act`` and ``beso``: that of the other policies."""

from lerobot_swr.policies.processor_swr import make_bc_pre_post_processors

make_ddpm_gpt_pre_post_processors = make_bc_pre_post_processors
make_ddpm_act_pre_post_processors = make_bc_pre_post_processors
make_beso_pre_post_processors = make_bc_pre_post_processors
