"""The files that ship: models, and the demo, which is a data set, a model, its baseline, and a flight over a map."""

from __future__ import annotations

from pathlib import Path

from lpn.core.files import data_folder

_PACKAGE = Path(__file__).parents[1]
# A checkout has the assets beside its packages. The wheel has them inside `lpn`, as site-packages is shared (setup.py).
ASSETS = _PACKAGE / "assets" if (_PACKAGE / "assets").is_dir() else _PACKAGE.parent / "assets"
DEMO = ASSETS / "demo"
DEMO_MODEL = DEMO / "lpn.onnx"
# The model of one part, trained in the same way; the explorer offers it for comparison if the file exists.
DEMO_BASELINE = DEMO / "baseline.onnx"
# The folder of a map, and a rendered flight over it; the explorer offers both beside the city if they exist.
DEMO_FLIGHT = DEMO.with_name("demo-flight") / "map-in-spring", DEMO.with_name("demo-flight") / "flight-in-autumn"
# A real flight over a map that `lpn map --from-flight` made of other photos of the same flight.
DEMO_PLACE = DEMO.with_name("demo-place") / "caliterra-odd", DEMO.with_name("demo-place") / "caliterra-even"
# The flight's photo that the explorer shows first: the map is well assembled there.
DEMO_PHOTO = "IMG_9408.webp"
# The folder of the model's answers, beside the photos of each flight.
DEMO_ANSWERS = "answers"
# The query that the explorer shows first.
DEMO_QUERY = "0394/06"


def own_file(folder: Path, name: str) -> Path:
    """Return the path of a user's file: in the folder of the data set or flight, or for the demo in the user's data folder.

    Raises:
        OutputError: for the demo, if the user has no home folder.
    """
    shipped = {path.resolve() for path in (DEMO, DEMO_FLIGHT[1], DEMO_PLACE[1])}
    return data_folder() / folder.resolve().name / name if folder.resolve() in shipped else folder / name


def own_file_place(folder: Path, name: str, what: str) -> str:
    """Describe the path of `own_file` to a visitor of a served page, without folders of this machine.

    An example is "notes.csv, beside the data, on the computer that runs this page"; `what` is the noun for `folder`.
    """
    file = own_file(folder, name)
    beside = file.parent == folder
    place = f"{name}, beside the {what}" if beside else f"{'/'.join(file.parts[-3:])}, in the user's data folder"
    return f"{place}, on the computer that runs this page"
