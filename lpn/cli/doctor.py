"""The command that checks a machine, files, a data set, or a model: doctor."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from lpn.core.demo import DEMO
from lpn.core.errors import InputError

# The check of the machine must run without any package, and a broken package may raise anything.
with suppress(Exception):
    import tyro

    from lpn.models.adapters import Kind


@dataclass
class DoctorCommand:
    """Check this machine, files, a data set, or a model, and list contents and faults; ends with status 1 after a fault."""

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Stores, indexes, parts, models, and trainings, or folders of them, to compare with their checksums."""
    data: Path | None = None
    """Data set in any layout of docs/data.md; without it and paths, machine, packages, and demo are checked."""
    model: Path | None = None
    """Model to check: how far its evidence is exact, proved on pictures of --data, or on coloured squares without it."""
    kind: Kind | None = None
    """With --model: method of a published .pth, such as dac, if its entries do not identify it; see docs/models.md."""
    pooling: str | None = None
    """With --model: pooling of tokens, of timm:NAME:FILE, a folder of transformers, or an .onnx of tokens: mean, gem, cls,
    cls+mean, or rings:N; see docs/models.md."""
    quick: bool = False
    """Read only the header and end of each picture, without decoding it."""
    json: Path | None = None
    """File to write all findings to, with every name, as JSON."""

    def run(self) -> int:
        from lpn.core.files import check_outputs, printable

        if self.paths:
            if self.data or self.model or self.kind or self.pooling or self.quick or self.json:
                raise InputError(
                    f"{printable(str(self.paths[0]))} is compared with its checksums alone; leave the options out, or give a "
                    "data set's folder with --data, and a model to prove with --model."
                )
            from lpn.doctor.verify import verify

            return 0 if _printed(finding for path in self.paths for finding in verify(path))[1] else 1
        check_outputs((self.json, ".json"))
        if self.model is not None:
            return self._check_model(self.model)
        for option, given in (("--kind", self.kind), ("--pooling", self.pooling)):
            if given is not None:
                raise InputError(f"{option} needs --model; give both, or leave it out.")
        if self.data is None:
            return self._check_environment()  # works without any package

        from lpn.core.consoles import wide_console
        from lpn.datasets import open_dataset
        from lpn.doctor.dataset_check import check_dataset, print_report

        console = wide_console()
        report = check_dataset(open_dataset(self.data), not self.quick)
        print_report(report, console)
        self._write(report.to_dict())
        return 0 if report.healthy else 1

    def _check_model(self, file: Path) -> int:
        import lpn
        from lpn.core.files import printable
        from lpn.datasets import open_dataset
        from lpn.doctor import model_check

        if self.quick:
            raise InputError("--quick is about the pictures of a data set; leave --model out.")
        model = lpn.load(file, kind=self.kind, pooling=self.pooling)
        pictures = dict.fromkeys(model.views, model_check.noise())
        if self.data is not None:
            pictures = model_check.pictures_of(open_dataset(self.data))
            if not set(pictures) & set(model.views):
                raise InputError(
                    f"{printable(self.data.name)} has pictures of {', '.join(pictures) or 'no view'}, and the model describes "
                    f"{', '.join(model.views)}; give a data set that fits."
                )
        print(printable(f"{model.contract.method}: {model.describe()}"))
        print(printable(f"Level: {model.contract.claim}."), flush=True)
        findings, healthy = _printed(model_check.check_model(model, pictures))
        values = {"method": model.contract.method, "level": model.contract.claim, "fingerprint": model.fingerprint}
        self._write(values | {"views": [vars(one) for one in findings]})
        return 0 if healthy else 1

    def _check_environment(self) -> int:
        from lpn.doctor.environment_check import check_environment

        if self.quick:
            raise InputError("--quick is about the pictures of a data set; give one with --data.")
        findings, healthy = _printed(check_environment(DEMO))
        print("Nothing that is needed is broken." if healthy else "Something is broken: see the problems above.")
        self._write({"healthy": healthy, "findings": [vars(one) for one in findings]})
        return 0 if healthy else 1

    def _write(self, values: dict[str, Any]) -> None:
        from lpn.core.files import write_json

        if self.json is not None:
            write_json(self.json, values)


def _printed(findings: Iterable[Any]) -> tuple[list[Any], bool]:
    """Print findings as they come; return them, and whether all are healthy."""
    found = []
    for finding in findings:
        found.append(finding)
        print(finding.line, flush=True)
    return found, all(finding.healthy for finding in found)
