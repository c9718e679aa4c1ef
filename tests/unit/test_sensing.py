"""The windowed kernel against the dense float64 formula, written here as the paper prints it."""

from collections.abc import Callable

import numpy as np
import pytest

from protocol.field import VirtualField
from protocol.geometry import Floats, optical_axis
from protocol.importance import ImportanceField
from protocol.mission import Sensing, Target
from protocol.sensing import owned_shares

DT = 0.05
TARGET = Target()
SENSING = Sensing(exponent_cut=60.0)  # far enough that what is cut is below float32's resolution


def dense_h1(pose: np.ndarray, field: VirtualField, sensing: Sensing) -> np.ndarray:
    """Eq. (1) for every cell, (positions, directions), float64."""
    to_cell = field.positions() - pose[:3]
    r = np.linalg.norm(to_cell, axis=1)
    sight = to_cell / r[:, None]
    c1 = sight @ optical_axis(pose[3], pose[4])
    c2 = -sight @ field.directions.T
    return (
        np.exp(-((1 - c1) ** 2) / (2 * sensing.sigma_axis**2))[:, None]
        * np.exp(-((1 - c2) ** 2) / (2 * sensing.sigma_view**2))
        * np.exp(-((r - sensing.distance_m) ** 2) / (2 * sensing.sigma_distance_m**2))[:, None]
    )


def random_team(drones: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    lower, upper = [-3, -3, 0.6, -np.pi, np.pi / 3], [3, 3, 2.5, np.pi, np.pi / 2]
    return rng.uniform(lower, upper, (drones, 5))


def close_team(drones: int, seed: int) -> np.ndarray:
    """Drones so near each other that most cells are contested."""
    rng = np.random.default_rng(seed)
    return np.array([0.3, -0.2, 1.6, 0.4, 1.3]) + rng.uniform(-0.4, 0.4, (drones, 5)) * [1, 1, 0.5, 1, 0.3]


def random_phi(field: VirtualField, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 2, field.shape).astype(np.float32)


@pytest.mark.parametrize("team", [random_team, close_team])
@pytest.mark.parametrize("drones", [1, 2, 4, 7])
def test_one_tick_equals_the_dense_formula(team: Callable[[int, int], Floats], drones: int) -> None:
    field = VirtualField.of(TARGET)
    poses = team(drones, drones)
    importance = ImportanceField(field, SENSING)
    importance.phi[:] = random_phi(field, seed=5)
    before = importance.phi.astype(np.float64)
    h = np.stack([dense_h1(pose, field, SENSING) for pose in poses])
    owner = h.argmax(axis=0)

    own = drones - 1
    terms = importance.advance(poses, DT, own)

    assert importance.phi == pytest.approx(before * np.exp(-SENSING.decay_per_s * DT * h.max(axis=0)), rel=1e-5)
    mine = owner == own
    assert terms.first == pytest.approx((h[own] * before)[mine].sum(), rel=1e-5)
    assert terms.second == pytest.approx((h[own] ** 2 * before)[mine].sum(), rel=1e-5)
    gradient = np.empty(5)
    for axis in range(5):
        step = np.zeros(5)
        step[axis] = 1e-6
        difference = dense_h1(poses[own] + step, field, SENSING) - dense_h1(poses[own] - step, field, SENSING)
        gradient[axis] = (difference / 2e-6 * before)[mine].sum()
    assert terms.gradient == pytest.approx(gradient, rel=1e-5, abs=1e-5 * np.abs(gradient).max())


def test_the_default_cut_leaves_only_cells_that_hardly_decay() -> None:
    field = VirtualField.of(TARGET)
    poses = random_team(4, seed=9)
    cut, full = ImportanceField(field, Sensing()), ImportanceField(field, SENSING)
    cut.advance(poses, DT)
    full.advance(poses, DT)
    assert cut.phi == pytest.approx(full.phi, rel=1e-5)


def test_importance_is_the_mean_of_phi() -> None:
    field = VirtualField.of(TARGET)
    importance = ImportanceField(field, Sensing())
    assert importance.importance == 1.0
    for tick in range(50):
        importance.advance(random_team(3, seed=tick), DT)
    importance.jump(np.random.default_rng(0).uniform(0, 1, field.shape[0]).astype(np.float32))
    for tick in range(50):
        importance.advance(random_team(3, seed=tick), DT)
    assert importance.importance == pytest.approx(importance.phi.mean(dtype=np.float64), abs=1e-9)


def test_a_jump_raises_every_direction_of_a_position_alike() -> None:
    importance = ImportanceField(VirtualField.of(TARGET), Sensing())
    increments = np.zeros(importance.field.shape[0], np.float32)
    increments[7] = 0.5
    importance.jump(increments)
    assert (importance.phi[7] == 1.5).all()
    assert importance.phi.sum(dtype=np.float64) == importance.field.size + 0.5 * importance.field.shape[1]


@pytest.mark.parametrize(("first", "end"), [(0, 32), (1000, 1032), (1391, 1450), (2768, 2800)])
def test_a_part_of_the_field_changes_as_the_whole_does_to_the_last_bit(first: int, end: int) -> None:
    field = VirtualField.of(TARGET)
    whole = ImportanceField(field, Sensing())
    whole.phi[:] = random_phi(field, seed=2)
    part = whole.part(first, whole.phi[first:end])
    poses = np.vstack([random_team(4, seed=3), [[*place, 0.4, 1.3] for place in field.positions()[[first, end - 1]]]])
    poses[4:, 2] += 1.0  # these two look at the part
    increments = np.random.default_rng(0).uniform(0, 1, field.shape[0]).astype(np.float32)

    for changed in (whole, part):
        for own in range(6):
            changed.advance(poses[: 6 - own], DT, own - 1)
            changed.jump(increments)

    assert part.phi.tobytes() == whole.phi[first:end].tobytes()
    assert (part.phi != random_phi(field, seed=2)[first:end] + 6 * increments[first:end, None]).any(), "nobody saw it"
    assert part.importance == pytest.approx(part.phi.sum(dtype=np.float64) / field.size, abs=1e-12)


def test_increments_that_came_over_the_bus_can_be_jumped_by() -> None:
    """They are read-only."""
    importance = ImportanceField(VirtualField.of(TARGET), Sensing())
    increments = np.full(importance.field.shape[0], 0.25, np.float32)
    importance.jump(np.frombuffer(increments.tobytes(), np.float32))
    assert (importance.phi == 1.25).all()
    assert importance.importance == 1.25


@pytest.mark.parametrize("drones", [1, 3, 5])
def test_the_coarse_lattice_estimates_owned_cells_within_a_hundredth_of_the_field(drones: int) -> None:
    field = VirtualField.of(TARGET)
    for team in (close_team, random_team):
        poses = team(drones, seed=3)
        exact = owned_shares(field.xs, field.ys, field.zs, field.directions, poses, (0.07, 0.095, 0.3), 1.0, stride=1)
        with np.errstate(divide="ignore"):
            h = np.stack([np.log(dense_h1(pose, field, Sensing())) for pose in poses])
        known = np.isfinite(h).any(axis=0)  # where the dense product underflows to zero it cannot tell
        owners = np.bincount(h.argmax(axis=0)[known], minlength=drones)
        assert np.abs(exact * field.size - owners).max() <= field.size - known.sum() + 1e-6
        assert ImportanceField(field, Sensing()).owned_cells(poses) / field.size == pytest.approx(exact, abs=0.01)


def test_a_tie_goes_to_the_lowest_row() -> None:
    field = VirtualField.of(TARGET)
    pose = random_team(1, seed=1)
    twins = np.vstack([pose, pose])
    importance = ImportanceField(field, Sensing())
    assert importance.advance(twins, DT, own=1).first == 0.0
    assert importance.owned_cells(twins).tolist() == [field.size, 0.0]


def test_the_paper_s_two_fields_have_its_cell_counts() -> None:
    assert VirtualField.of(Target()).shape == (20 * 20 * 7, 21 * 2)
    assert VirtualField.of(Target(cell_m=0.1, cell_rad=0.12)).size == 14_976_000


def test_a_drone_that_sees_no_cell_changes_nothing() -> None:
    importance = ImportanceField(VirtualField.of(TARGET), Sensing())
    terms = importance.advance(np.array([[50.0, 50.0, 50.0, 0.0, 1.2]]), DT, own=0)
    assert (importance.phi == 1).all()
    assert terms.first == 0.0
    assert not terms.gradient.any()


def test_reading_the_terms_changes_nothing_and_gives_what_a_decay_would_have_given() -> None:
    """Also for a drone whose cells others contest."""
    poses = np.array([[0.0, 0.0, 1.9, 0.0, 1.4], [0.3, 0.1, 2.0, 0.5, 1.3], [-0.2, 0.3, 1.8, 2.0, 1.5]])
    for own in range(3):
        field = ImportanceField(VirtualField.of(Target(cell_m=0.4, cell_rad=0.5)), Sensing())
        field.advance(poses[::-1], 0.5, 0)
        before = field.phi.tobytes()
        read = field.terms(poses, own)
        assert field.phi.tobytes() == before
        importance = field.importance
        decayed = field.advance(poses, 0.05, own)

        assert field.importance < importance
        assert read.gradient == pytest.approx(decayed.gradient, rel=1e-6)
        assert (read.first, read.second) == pytest.approx((decayed.first, decayed.second), rel=1e-6)
        assert read.first > 0
