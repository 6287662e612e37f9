"""Make `docs/gallery.md`: the scenes of this repository, each as the program draws it and in its own words.

    python tools/gallery.py [SCENE…]

draws `docs/gallery/SCENE.jpg`, all of them or those named, by what `nir-render look` draws; the text is what
the scene file begins with. Run it where a scene or the drawing has changed.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from nir_render.look.sheet import look_png
from nir_render.run.folder import write_file
from nir_render.scene.load import load_scene

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "gallery.md"
PICTURES = ROOT / "docs" / "gallery"
SHOWN = {
    "Rooms and halls": ("arena", "corridor", "clutter_around", "crowd", "warehouse", "workshop"),
    "Mirrors and glass": ("glass_room", "mirror_corridor", "retroreflectors"),
    "Out of doors, and in fog": ("sunlit_yard", "yard_in_fog", "ground_fog", "foggy_hall", "greenhouse"),
    "Robots that move and talk": ("crossing", "occlusion", "sixteen_talkers", "swarm_30"),
}
WIDTH_PX, QUALITY = 960, 80
HEAD = """# Gallery

Scenes of this repository, as `nir-render look SCENE` draws them: bodies in grey from outside and from above,
over them robots, what their cameras see, lamps and fog. This page is made by `tools/gallery.py`.
"""


def words(scene: str) -> str:
    """Return what a scene file says of itself: the comment that it begins with."""
    lines = []
    for line in (ROOT / "scenes" / f"{scene}.yaml").read_text(encoding="utf-8").splitlines()[1:]:
        if not line.startswith("#") or "nir-render" in line:
            break
        lines.append(line.removeprefix("#").strip())
    # A sentence that goes on with the command is left out with it.
    text = " ".join(lines).removesuffix("Run it with:").strip()
    end = text.rfind(".") + 1
    return text[: end + text[end:].startswith(")")]


def page() -> str:
    """Return the page's text."""
    parts = [HEAD]
    for title, scenes in SHOWN.items():
        parts.append(f"## {title}\n")
        parts += [
            f"![{scene}, from outside and from above](gallery/{scene}.jpg)\n\n"
            f"`scenes/{scene}.yaml`: {words(scene)}\n"
            for scene in scenes
        ]
    return "\n".join(parts)


def picture(scene: str) -> bytes:
    """Draw a scene as a JPEG."""
    png = look_png(load_scene(ROOT / "scenes" / f"{scene}.yaml"))
    drawn = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert drawn is not None  # it has just been written
    rows, columns = drawn.shape[:2]
    small = cv2.resize(drawn, (WIDTH_PX, round(rows * WIDTH_PX / columns)), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


def main() -> None:
    """Draw, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    known = [scene for scenes in SHOWN.values() for scene in scenes]
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(known))
    for scene in parser.parse_args().scenes or known:
        write_file(PICTURES / f"{scene}.jpg", picture(scene))
    write_file(PAGE, page().encode())


if __name__ == "__main__":
    main()
