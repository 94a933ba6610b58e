"""The explorer on exact and noisy contacts of a ball: it covers its rectangle, smoothly, and turns back from edges."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import PAD_NOISE, PadLayer, SurfaceMap
from canprobe.mechanics.touch.explore.explorer import Explorer
from canprobe.mechanics.touch.explore.ground import GroundCells
from canprobe.mechanics.touch.explore.lanes import LaneForecast
from canprobe.mechanics.touch.map.nodes import COLUMNS
from canprobe.mechanics.touch.map.stiffness import Stiffness
from canprobe.mechanics.touch.strategies import Rectangle

PAD = PadLayer(0.04, 1.27e8)
DEPTH, BALL, RADIUS, STEP = 0.43e-3, 0.06, 2e-3, 6.25e-5
BEGIN = (1e-3, -0.5e-3)


class Scanned:
    """A ball under a pad whose contacts have the noise that the map expects, as far as it is independent."""

    def __init__(self, rectangle):
        self.map = SurfaceMap.of_nodes(np.zeros((0, COLUMNS)), PAD, PAD_NOISE, Stiffness(PAD.stiffness, 0.035))
        self.rng = np.random.default_rng(3)
        self.cells = GroundCells(self.map, np.zeros(3), np.eye(3), rectangle, stiffness_sigma=0.035)

    def contact(self, x, y):
        point = np.array([x, y, math.sqrt(BALL**2 - x * x - y * y) - BALL])
        normal = np.add(point, (0.0, 0.0, BALL)) / BALL
        noisy = normal + self.rng.normal(0.0, 3e-4, 3)
        self.map.add(point + normal * self.rng.normal(0.0, 5e-6), noisy / np.linalg.norm(noisy), 2.0)
        return point, normal


def explore(rectangle, edge=math.inf):
    """Explore up to an edge, round which the probe turns; the places and headings of the path, and how often back."""
    scanned = Scanned(rectangle)
    forecast = LaneForecast(PAD.radius, DEPTH, PAD_NOISE)
    size = rectangle.length, rectangle.width
    explorer = Explorer(scanned.cells, forecast, size, start=BEGIN, radius=RADIUS, ahead=2.5e-3, lag=0.0)
    x, y = BEGIN
    path, backs = [], 0
    while scanned.cells.wanting.any() and explorer.path < 0.5:
        along, across = explorer.step(x, y, STEP)
        x, y = x + STEP * along, y + STEP * across
        path.append((x, y, along, across))
        point, normal = scanned.contact(min(x, edge), y)
        normal = np.add(normal, (max(0.0, x - edge) / 0.02, 0.0, 0.0))
        explorer.walk(point, normal / np.linalg.norm(normal), 1.0)
        if explorer.at_edge and not explorer.going_back:
            explorer.turn_back()
            backs += 1
        explorer.work()
    return scanned, explorer, np.array(path), backs


@pytest.fixture(scope="module")
def explored():
    return explore(Rectangle(0.024, 0.018, 14e-6))


def test_it_ends_with_the_target_in_every_cell_inside_the_rectangle(explored):
    scanned, explorer, path, backs = explored
    assert explorer.path < 0.2
    assert scanned.cells.largest <= 14e-6
    assert (np.abs(path[:, :2]) <= [0.0125, 0.0095]).all()
    assert backs == 0


def test_the_heading_turns_no_faster_than_the_servo_follows(explored):
    _, _, path, _ = explored
    turns = np.abs(np.diff(np.unwrap(np.arctan2(path[:, 3], path[:, 2]))))
    assert np.quantile(turns, 0.99) < 1.3 * STEP / RADIUS
    assert turns.max() < 2.0 * STEP / RADIUS


def test_its_deviation_is_that_of_the_map(explored):
    scanned, *_ = explored
    x, y = scanned.cells.places.T
    points = np.column_stack([x, y, np.sqrt(BALL**2 - x * x - y * y) - BALL])
    _, sigma = scanned.map.distance(points)
    assert np.isfinite(sigma).all()
    assert np.median(scanned.cells.sigma / sigma) == pytest.approx(1.0, abs=0.4)


def test_it_turns_back_from_an_edge_and_closes_what_lies_beyond():
    edge = 6e-3
    scanned, _, path, backs = explore(Rectangle(0.024, 0.018, 20e-6), edge)
    assert 1 <= backs < 12
    assert path[:, 0].max() < edge + 6e-3
    assert not scanned.cells.wanting.any()
    closed = scanned.cells.places[scanned.cells.closed]
    assert (closed[:, 0] > edge - 1e-3).all()
    assert np.count_nonzero(closed[:, 0] > 9e-3) == 6  # the outermost row, all of it
