"""Parity on a GPU: `python -m tools.bench.gpu`.

The table has the 13 checkpoints of `tools.fixtures.parity`, in the published format and with seeded weights. Two of them
are compared with arrays of the published implementation, eleven with `tools.fixtures.published_network`, our second one. The
figure is the largest difference of the head outputs relative to the largest value: in float32, which must stay below 1e-4, and
in mixed precision, which need not. Below them is the
exported model by each of ONNX Runtime's providers. Without a GPU the program says so in a sentence.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from lpn.core.errors import LPNError
from lpn.models.checkpoints import load_torch
from lpn.models.export import export
from lpn.models.onnx_engine import Engine
from lpn.models.providers import available
from tools.bench.figures import machine
from tools.fixtures.parity import CASES, TOLERANCE, ParityCase
from tools.fixtures.seeded import relative

MIXED = {"float16": torch.float16, "bfloat16": torch.bfloat16}
# The case that is exported, a ResNet-50 of three views with four parts.
EXPORTED = CASES[3]
# To try the program: a checkpoint of few layers and small pictures, which is exported, too.
TINY_CASE = ParityCase("vgg16_bn", 3, 1, ("drone",), size=64, options=True)


@dataclass(frozen=True)
class ParityRow:
    """The differences of one model from the expected head outputs.

    Attributes:
        what: the checkpoint, or the provider.
        differences: by precision, relative to the largest expected value.
        failure: why there are none.
    """

    what: str
    differences: dict[str, float] = field(default_factory=dict)
    failure: str = ""

    @property
    def agrees(self) -> bool:
        """True if the float32 outputs are those expected."""
        return self.differences.get("float32", float("inf")) <= TOLERANCE


def parity(device: torch.device, cases: Sequence[ParityCase]) -> Iterator[ParityRow]:
    """Compare each case in float32 and in mixed precision."""
    for case in cases:
        with tempfile.TemporaryDirectory() as folder:
            model = load_torch(case.write(Path(folder)), device)
        found = dict.fromkeys(("float32", *MIXED), 0.0)
        for view in case.compared:
            expected = case.expected(view)
            outputs = {"float32": model.part_embeddings(case.pictures(), view)}
            for name, dtype in MIXED.items():
                with torch.inference_mode(), torch.autocast(device.type, dtype):
                    outputs[name] = model.network.embed(case.pictures().to(device), view)[0].float().cpu().numpy()
            for name, array in outputs.items():
                found[name] = max(found[name], relative(array, expected))
        yield ParityRow(str(case), found)


def provider_parity(case: ParityCase) -> Iterator[ParityRow]:
    """Compare the exported case by each provider that ONNX Runtime was built with."""
    view = case.compared[0]
    with tempfile.TemporaryDirectory() as folder:
        export(case.write(Path(folder)), file := Path(folder, "model.onnx"))
        for provider in available():
            what = f"exported, ONNX Runtime, {provider}"
            try:
                found = Engine(file, provider=provider).part_embeddings(case.pictures(), view)
            except LPNError as error:
                yield ParityRow(what, failure=str(error))
            else:
                yield ParityRow(what, {"float32": relative(found, case.expected(view))})


def parity_table(rows: Sequence[ParityRow]) -> Table:
    """Return the table of differences."""
    table = Table(
        title=f"Largest difference from the expected head outputs, relative to the largest value; {machine()}"
    )
    table.add_column("checkpoint")
    for name in ("float32", f"at most {TOLERANCE:.0e}", *MIXED):
        table.add_column(name, justify="right")
    for row in rows:
        cells = {name: f"{value:.1e}" for name, value in row.differences.items()}
        verdict = "not run" if row.failure else "met" if row.agrees else "missed"
        table.add_row(row.what, cells.get("float32", ""), verdict, *(cells.get(name, "") for name in MIXED))
    return table


def main() -> None:
    """Check parity, and print the table; ends with status 1 if float32 does not agree."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", default="cuda", help="cuda, or cpu to try the program")
    parser.add_argument("--tiny", action="store_true", help="one small checkpoint, to try the program")
    options = parser.parse_args()
    if options.device != "cpu" and not torch.cuda.is_available():
        raise SystemExit(
            f"torch {torch.__version__} finds no GPU here, so nothing was measured; run this on a machine with one, or give "
            "--device cpu."
        )
    rows = list(parity(torch.device(options.device), [TINY_CASE] if options.tiny else CASES))
    rows += provider_parity(TINY_CASE if options.tiny else EXPORTED)
    console = Console(width=150)
    console.print(parity_table(rows))
    for row in rows:
        if row.failure:
            console.print(f"{row.what} was not run: {row.failure}")
    if not all(row.agrees for row in rows if not row.failure):
        raise SystemExit("The float32 outputs of a checkpoint above are not those expected; report this table.")


if __name__ == "__main__":
    main()
