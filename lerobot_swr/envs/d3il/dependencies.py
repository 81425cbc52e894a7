"""MuJoCo and numba, which only the D3IL tasks need: imported here, to explain once if one is missing."""

try:
    import mujoco
    import numba
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"the D3IL tasks need the package {error.name!r}: run pip install 'lerobot_policy_swr[d3il]'",
        name=error.name,
    ) from error

__all__ = ["mujoco", "numba"]
