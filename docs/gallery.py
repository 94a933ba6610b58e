"""Draw docs/img/scenes/SCENE.png: the best panel of each packaged scene's report. `python docs/gallery.py [SCENE …]`

Each scene runs once without a bus (`--bus direct`, seed 0). `python docs/generate.py` puts the pictures into the page.
"""

from __future__ import annotations

import sys
from pathlib import Path

from matplotlib.transforms import Bbox
from PIL import Image, ImageOps

import canprobe
from canprobe.cell.scene.load import packaged

FOLDER = Path(__file__).parent / "img" / "scenes"
DPI = 100
COLOURS = 64
PANELS = {"listen": (0, 1), "calibrate": (1, 0)}
"""Row and column of the panel that shows a scene best; of the others the first."""
BORDER = 6


def draw(name: str) -> Path:
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


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for scene, _ in packaged("scene"):
        if not sys.argv[1:] or scene in sys.argv[1:]:
            print(draw(scene), flush=True)
