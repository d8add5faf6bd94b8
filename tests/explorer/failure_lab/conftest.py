"""A workspace of thirteen places with metadata, opened once, and its failure laboratory."""

from __future__ import annotations

from pathlib import Path

import pytest

from explorer.failure_lab.service import FailureLab, Findings
from explorer.failure_lab.state import LabState
from explorer.opening import open_model
from explorer.workspace import Workspace
from tools.fixtures import small_worlds

TASK = "drone-to-satellite"
WEATHERS = ("<b>rain", 'say "hi"', "sun")


@pytest.fixture(scope="package")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    data = small_worlds.map_dataset(
        small_worlds.make_dataset(tmp_path_factory.mktemp("lab") / "places", train=1, test=13)
    )
    lines = ["path,weather"]
    for i, file in enumerate(sorted((data / "test" / "query_drone").rglob("*.png"))):
        weather = WEATHERS[i % 3].replace('"', '""')
        lines.append(f'{file.relative_to(data).as_posix()},"{weather}"')
    (data / "metadata.csv").write_text("\n".join(lines))
    opened = open_model(data, model_file)
    # The untrained network happens to find some of the 13 places and to miss others; the tests need both.
    assert 0 < (opened.rankings[TASK].ranks > 0).sum() < 13
    return opened


@pytest.fixture
def service(workspace: Workspace) -> FailureLab:
    return FailureLab(workspace)


@pytest.fixture
def findings(service: FailureLab) -> Findings:
    assert service.build(TASK, None).wait(120)
    computed = service.findings(TASK)
    assert computed is not None
    return computed


@pytest.fixture
def lab() -> LabState:
    return LabState(task=TASK)
