"""Weights as files: those that are shipped, and a mission's own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from ground_station.reconstruction.learned.requirements import require_torch
from protocol.errors import ReconstructionError

if TYPE_CHECKING:
    from ground_station.reconstruction.learned.network import Network

SHIPPED: Final = Path(__file__).parent / "weights" / "rooms.safetensors"


def load_network(path: Path = SHIPPED) -> Network:
    """A network ready to predict. Raises `ReconstructionError`, naming the file, if these are no weights for it."""
    require_torch()
    import torch
    from safetensors import SafetensorError, safe_open

    from ground_station.reconstruction.learned.network import ARCHITECTURE, Network

    try:
        with safe_open(path, framework="pt") as file:
            architecture = (file.metadata() or {}).get("architecture", "none")
            tensors = {name: file.get_tensor(name).to(torch.float32) for name in file.keys()}  # noqa: SIM118  # no dict
    except (OSError, SafetensorError) as error:
        raise ReconstructionError(f"{path}: no weights of the learned reconstructor: {error}") from error
    if architecture != ARCHITECTURE:
        raise ReconstructionError(
            f"{path}: weights for architecture {architecture!r}, this release has {ARCHITECTURE!r}"
        )
    network = Network()
    wanted = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    given = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if wanted != given:
        wrong = sorted(name for name in wanted.keys() | given.keys() if wanted.get(name) != given.get(name))
        raise ReconstructionError(
            f"{path}: weights do not fit the network: {', '.join(wrong[:3])} and {len(wrong)} in all"
        )
    if not all(tensor.isfinite().all() for tensor in tensors.values()):
        raise ReconstructionError(f"{path}: weights that are not finite")
    network.load_state_dict(tensors)
    network.eval()
    return network


def save_network(path: Path, network: Network) -> None:
    """Write its weights in half precision; equal weights are equal files."""
    from safetensors.torch import save

    from ground_station.durable import replace_file
    from ground_station.reconstruction.learned.network import ARCHITECTURE

    halves = {name: tensor.half().contiguous() for name, tensor in network.state_dict().items()}
    content = save(halves, metadata={"architecture": ARCHITECTURE})  # two keys would come in any order
    replace_file(path, [content])
