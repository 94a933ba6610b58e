"""The explorer on exact and noisy contacts of a ball: it covers its rectangle, smoothly, with a forecast that holds."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch.explore.explorer import Explorer
from canprobe.mechanics.touch.explore.forecast import UNKNOWN_M, Forecast
from canprobe.mechanics.touch.explore.ground import GroundCells
from canprobe.mechanics.touch.map.local_fits import PadLayer
from canprobe.mechanics.touch.map.nodes import COLUMNS
from canprobe.mechanics.touch.map.noise import PAD_NOISE
from canprobe.mechanics.touch.map.stiffness import Stiffness
from canprobe.mechanics.touch.map.surface_map import SurfaceMap
from canprobe.mechanics.touch.strategies import Rectangle

PAD = PadLayer(0.04, 1.27e8)
DEPTH, BALL, RADIUS, STEP = 0.43e-3, 0.06, 2e-3, 2.5e-4


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
    forecast = Forecast(scanned.cells.places, PAD.radius, DEPTH, PAD_NOISE)
    size = rectangle.length, rectangle.width
    explorer = Explorer(scanned.cells, forecast, size, radius=RADIUS, ahead=1e-2, lag=0.0)
    x = y = 0.0
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


def test_one_line_leaves_the_height_open_and_a_second_one_beside_it_does_not():
    """The depth of the layer depends on the curvature across a line, which the line does not show."""
    forecast = Forecast(np.array([[0.0, 0.0]]), PAD.radius, DEPTH, PAD_NOISE)
    assert forecast.variance[0] == UNKNOWN_M**2
    line = np.column_stack([1e-3 * np.arange(-8.0, 9.0), np.zeros(17)])
    for x, y in line:
        forecast.walk(x, y)
    alone = math.sqrt(forecast.variance[0])
    with_second = forecast.after(np.add(line, (0.0, 4e-3)), line[:0], [17], np.array([0]))
    assert alone > 40e-6
    assert math.sqrt(with_second[0, 0]) < 0.3 * alone


def test_a_forecast_is_what_comes_true():
    forecast = Forecast(np.array([[0.0, 0.0], [3e-3, 0.0]]), PAD.radius, DEPTH, PAD_NOISE)
    path = np.random.default_rng(4).uniform(-6e-3, 6e-3, (12, 2))
    ahead = forecast.after(path[5:], path[:5], [1, 7], np.array([0, 1]))
    for x, y in path[:6]:
        forecast.walk(x, y)
    assert forecast.variance == pytest.approx(ahead[0], rel=1e-6)
    for x, y in path[6:]:
        forecast.walk(x, y)
    assert forecast.variance == pytest.approx(ahead[1], rel=1e-6)
