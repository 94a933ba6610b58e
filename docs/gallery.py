"""Draw docs/img/scenes/SCENE.png: the best panel of each packaged scene's report.

`python docs/measure.py pictures` draws them. Each scene runs once without a bus (`--bus direct`, seed 0). Then
`python docs/generate.py` puts them into the page.
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.transforms import Bbox
from PIL import Image, ImageOps

import canprobe

FOLDER = Path(__file__).parent / "img" / "scenes"
DPI = 100
COLOURS = 64
PANELS = {"listen": (0, 1), "calibrate": (1, 0)}
"""Row and column of the panel that shows a scene best; of the others the first."""
BORDER = 6


def draw_panel(name: str) -> Path:
    """Run a scene and save one panel of its figure, without the white space round it."""
    figure = canprobe.run(name, bus="direct", seed=0, files=False).plot()
    figure.suptitle("")
    figure.set_dpi(DPI)
    figure.canvas.draw()  # lays it out
    row, column = PANELS.get(name, (0, 0))
    panel = figure.subfigs[row].subfigs[column]
    path = FOLDER / f"{name}.png"
    corners = panel.bbox.transformed(figure.dpi_scale_trans.inverted())
    figure.savefig(path, dpi=DPI, bbox_inches=Bbox(corners.get_points()))
    with Image.open(path) as opened:
        image = ImageOps.expand(opened.convert("RGB"), BORDER, "white")
    left, top, right, bottom = ImageOps.invert(image).getbbox() or (0, 0, *image.size)
    image = image.crop((left - BORDER, top - BORDER, right + BORDER, bottom + BORDER))
    image.quantize(COLOURS).save(path, optimize=True)
    return path
