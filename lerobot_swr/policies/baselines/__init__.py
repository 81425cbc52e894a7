"""The paper's baselines as LeRobot policies: ``ddpm_gpt``, ``ddpm_act`` and ``beso`` (docs/baselines.md)."""
