"""The moving average of a network's weights, which acts in its place."""

from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

Parameters = tuple[Tensor, ...] | list[Tensor]


def moving_average(network: nn.Module, decay: float) -> AveragedModel:
    """An exponential moving average of a network's weights; ``update_parameters(network)`` goes on with it.

    The n-th update keeps a share of min(decay, (1 + n) / (10 + n)) of the average, as in D3IL's agents: it
    forgets the initial weights soon. Average and n are in the state dict; the average is not trained.

    Args:
        network: The network.
        decay: Largest share that an update keeps, 0 to 1.
    """

    def update(averaged: Parameters, current: Parameters, count: Tensor | int) -> None:
        n = int(count) + 1
        get_ema_multi_avg_fn(min(decay, (1 + n) / (10 + n)))(averaged, current, count)

    return AveragedModel(network, multi_avg_fn=update).requires_grad_(False)
