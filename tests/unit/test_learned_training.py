"""What the learned reconstructor learns from, that a resumed training learns the same, which weights are refused."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from deploy.doctor.examination import _needed_sets
from ground_station.reconstruction.learned import requirements
from ground_station.reconstruction.learned.fragment import FINE_M, REACH_M
from ground_station.reconstruction.learned.training.folder import begin, missing_rooms, read_settings, room_path
from ground_station.reconstruction.learned.training.lessons import STEPS, _turned, draw_lesson, load_room, to_coarse
from ground_station.reconstruction.learned.training.settings import TrainingSettings, load_settings
from protocol.errors import ReconstructionError, TrainingError
from protocol.map_settings import Learned, Reconstruction
from protocol.mission import Drone, Mission, Target

needs_torch = pytest.mark.skipif(
    any(find_spec(name) is None for name in requirements.MODULES), reason="the extra learned is not installed"
)
TINY = TrainingSettings(
    rooms=1,
    held_out=1,
    first_room=0,
    steps=4,
    warm_up=2,
    window=(8, 8, 8),
    refined=64,
    bfloat16=False,  # what the processor lacks, it imitates slowly
    measured_every=2,
    measured_lessons=1,
)


def write_bare_room(path: Path, seed: int) -> None:
    """A floor of random patches, photographed from straight above along a line: a room as the simulator writes it."""
    rng = np.random.default_rng(seed)
    count, height, width = 8, 24, 32
    lower, upper = np.array(Target().lower_m) - REACH_M, np.array(Target().upper_m) + REACH_M
    shape = np.rint((upper - lower) / FINE_M).astype(int) + 1
    above = lower[2] + FINE_M * np.arange(shape[2])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path,
        images=rng.integers(0, 255, (count, height, width, 3), dtype=np.uint8),
        depth=np.full((count, height // 2, width // 2), 1.5, np.float16),
        poses=np.column_stack([np.linspace(-0.8, 0.8, count), *np.tile([[0.0], [1.5], [0.0], [np.pi / 2]], count)]),
        focal_px=np.full(count, 0.7 * width),
        sortie=np.zeros(count, int),
        origin=lower,
        voxel=np.array(FINE_M),
        distance=np.broadcast_to(np.minimum(np.abs(above), REACH_M), shape).astype(np.float16),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("training")
    for seed in (*TINY.room_seeds, *TINY.held_out_seeds):
        write_bare_room(room_path(made, seed), seed)
    return made


def test_a_room_says_what_was_seen_and_on_which_side_it_lies(folder: Path) -> None:
    room = load_room(room_path(folder, 0))
    middle = room.distance.shape[0] // 2
    floor = int(np.rint(-room.origin[2] / FINE_M))
    column = room.distance[middle, middle]
    assert column[floor : floor + 5].tolist() == [0, 42, 85, STEPS, STEPS]
    assert column[floor - 2 : floor].tolist() == [-85, -42]
    assert room.occupied[middle, middle, floor - 2 : floor + 4].tolist() == [True] * 5 + [False]
    assert not room.occupied[0, 0].any(), "a corner that no photograph shows"
    assert (room.distance[0, 0] == -STEPS).all()


def test_a_lesson_hangs_on_its_draw_alone(folder: Path) -> None:
    rooms = [load_room(room_path(folder, 0))]
    one, same, other = (draw_lesson(rooms, TINY, draw) for draw in (3, 3, 4))
    assert np.array_equal(one.images, same.images)
    assert np.array_equal(one.projections, same.projections)
    assert not np.array_equal(one.projections, other.projections)
    assert one.distance.shape == (16, 16, 16)
    assert one.images.min() >= 0
    assert one.images.max() <= 1


def test_answers_are_turned_as_the_window_is() -> None:
    rng = np.random.default_rng(1)
    distance, occupied = rng.integers(-STEPS, STEPS, (6, 6, 4)).astype(np.int8), rng.random((6, 6, 4)) < 0.5
    seen = set()
    for _ in range(40):
        to_old, turned, also = _turned(distance, occupied, rng)
        places = np.indices(turned.shape).reshape(3, -1)
        old = to_old @ np.vstack([FINE_M * places, np.ones(places.shape[1])])
        old_places = tuple(np.rint(old[:3] / FINE_M).astype(int))
        assert np.array_equal(turned[tuple(places)], distance[old_places])
        assert np.array_equal(also[tuple(places)], occupied[old_places])
        seen.add(to_old[:3, :3].tobytes())
    assert len(seen) == 8


def test_a_coarse_voxel_is_near_a_surface_if_any_of_its_fine_ones_is() -> None:
    distance, occupied = np.ones((4, 4, 4), np.float32), np.zeros((4, 4, 4), np.bool_)
    distance[0, 0, 0], occupied[0, 0, 0] = -1.0, True
    mean, near = to_coarse(distance, occupied)
    assert mean[0, 0, 0] == pytest.approx(0.75)
    assert near[0, 0, 0]
    assert np.count_nonzero(near) == 1


def test_a_damaged_room_is_named(tmp_path: Path) -> None:
    path = tmp_path / "room-0.npz"
    path.write_bytes(b"no room")
    with pytest.raises(TrainingError, match=r"room-0\.npz"):
        load_room(path)


def test_settings_come_from_a_file_and_every_fault_is_told(tmp_path: Path) -> None:
    file = tmp_path / "training.toml"
    file.write_text("rooms = 5\nwindow = [16, 16, 28]\n")
    assert load_settings(file) == TrainingSettings(rooms=5, window=(16, 16, 28))
    file.write_text("roms = 5\nlearning_rate = -1\n")
    with pytest.raises(TrainingError, match=r"(?s)roms.*learning_rate|learning_rate.*roms"):
        load_settings(file)
    file.write_text("window = [10, 16, 28]\n")
    with pytest.raises(TrainingError, match="multiples of 4"):
        load_settings(file)


def test_a_folder_is_not_begun_twice_and_goes_on_only_with_its_settings(tmp_path: Path) -> None:
    begin(tmp_path, TINY, resume=False)
    assert read_settings(tmp_path) == TINY
    assert missing_rooms(tmp_path, TINY) == [0, 1]
    (tmp_path / "checkpoint.pt").touch()
    with pytest.raises(TrainingError, match="--resume"):
        begin(tmp_path, TINY, resume=False)
    with pytest.raises(TrainingError, match="other settings"):
        begin(tmp_path, TINY.model_copy(update={"seed": 2}), resume=True)
    begin(tmp_path, TINY.model_copy(update={"steps": 9}), resume=True)


@needs_torch
def test_the_rate_s_plateau_does_not_hang_on_the_number_of_steps() -> None:
    from ground_station.reconstruction.learned.training.trainer import rate

    settings = TrainingSettings(warm_up=10, decay_share=0.25)
    assert rate(settings, 0, 100) == pytest.approx(0.1)
    assert [rate(settings, step, 100) for step in (10, 50, 75)] == [rate(settings, step, 1000) for step in (10, 50, 75)]
    assert rate(settings, 90, 100) < 0.5
    assert rate(settings, 99, 100) < 0.01


@needs_torch
def test_a_resumed_training_gives_the_weights_of_one_without_a_break(folder: Path, tmp_path: Path) -> None:
    from ground_station.reconstruction.learned.training.course import run_course

    results = []
    for name, parts in (("whole", (4,)), ("broken", (2, 4))):
        own = tmp_path / name
        own.mkdir()
        (own / "rooms").symlink_to(folder / "rooms")
        for steps in parts:
            run_course(TINY.model_copy(update={"decay_share": 0.0}), own, steps=steps, resume=True)
        results.append((own / "weights.safetensors").read_bytes())
        assert (own / "curve.csv").read_text().count("\n") == 3
        assert (own / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert results[0] == results[1]


@needs_torch
def test_a_checkpoint_of_other_settings_and_a_damaged_one_are_refused(folder: Path, tmp_path: Path) -> None:
    from ground_station.reconstruction.learned.training.trainer import Trainer, load_checkpoint, save_checkpoint

    rooms = [load_room(room_path(folder, 0))]
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, Trainer(TINY, rooms, rooms))
    with pytest.raises(TrainingError, match="other settings"):
        load_checkpoint(path, Trainer(TINY.model_copy(update={"seed": 5}), rooms, rooms))
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(TrainingError, match=r"checkpoint\.pt: cannot be read"):
        load_checkpoint(path, Trainer(TINY, rooms, rooms))


@needs_torch
def test_the_shipped_weights_fit_the_network_and_are_small() -> None:
    from ground_station.reconstruction.learned.weights import SHIPPED, load_network

    network = load_network()
    assert 1_000_000 < sum(parameter.numel() for parameter in network.parameters()) < 4_000_000
    assert SHIPPED.stat().st_size < 10_000_000


@needs_torch
def test_weights_that_do_not_fit_are_refused_with_the_file_s_name(tmp_path: Path) -> None:
    import torch
    from safetensors.torch import save_file

    from ground_station.reconstruction.learned.network import ARCHITECTURE, Network
    from ground_station.reconstruction.learned.weights import load_network, save_network

    path = tmp_path / "own.safetensors"
    with pytest.raises(ReconstructionError, match=r"own\.safetensors"):
        load_network(path)
    path.write_bytes(b"nonsense")
    with pytest.raises(ReconstructionError, match=r"own\.safetensors: no weights"):
        load_network(path)
    network = Network()
    save_network(path, network)
    assert load_network(path).state_dict().keys() == network.state_dict().keys()
    tensors = dict(network.state_dict())
    save_file(tensors, path, metadata={"architecture": "another/1"})
    with pytest.raises(ReconstructionError, match="another/1"):
        load_network(path)
    name = next(iter(tensors))
    save_file(tensors | {name: torch.zeros(1)}, path, metadata={"architecture": ARCHITECTURE})
    with pytest.raises(ReconstructionError, match=name):
        load_network(path)
    save_file(tensors | {name: tensors[name] * torch.nan}, path, metadata={"architecture": ARCHITECTURE})
    with pytest.raises(ReconstructionError, match="not finite"):
        load_network(path)


def asked(weights: str = "") -> Mission:
    reconstruction = Reconstruction(backend="learned", learned=Learned(weights=weights))
    return Mission(drones=(Drone(id=1, start=(0, 0, 2, 0, 1.4)),), reconstruction=reconstruction)


def test_a_mission_without_torch_fails_before_the_flight_and_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requirements, "find_spec", lambda name: None if name == "torch" else find_spec(name))
    with pytest.raises(ReconstructionError, match=r"torch: run \.venv/bin/pip install -e '\.\[learned\]'"):
        requirements.require_backend(asked())
    requirements.require_backend(replace_backend(asked(), "plane_sweep"))
    assert "learned" in _needed_sets(asked(), 0)
    assert "learned" not in _needed_sets(asked(), 1), "a drone needs no network"


def test_a_mission_whose_weights_are_not_there_fails_before_the_flight(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(requirements, "find_spec", lambda _: object())
    with pytest.raises(ReconstructionError, match=r"weights: .*none\.safetensors is not a file"):
        requirements.require_backend(asked(str(tmp_path / "none.safetensors")))


def replace_backend(mission: Mission, backend: str) -> Mission:
    changed = mission.reconstruction.model_copy(update={"backend": backend})
    return mission.model_copy(update={"reconstruction": changed})
