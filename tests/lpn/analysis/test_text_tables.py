"""Tables as LaTeX: as many columns in each row, and nothing in a cell that LaTeX takes for a command."""

from __future__ import annotations

import re
from pathlib import Path

from lpn.analysis.text_tables import TableSection, TextTable, latex_page, latex_text
from lpn.cli.main import main
from lpn.reproduce import report
from lpn.reproduce.record import TableRecord, row_record


def columns(latex: str) -> list[list[int]]:
    """Return for each tabular the number of columns that it declares, and of each of its rows."""
    found = []
    for kinds, body in re.findall(r"\\begin\{tabular\}\{([lr]+)\}\n(.*?)\\end\{tabular\}", latex, re.DOTALL):
        rows = [line for line in body.splitlines() if line not in (r"\toprule", r"\midrule", r"\bottomrule")]
        assert all(row.endswith(r" \\") for row in rows)
        found.append([len(kinds), *(len(re.findall(r"(?<!\\)&", row)) + 1 for row in rows)])
    return found


def test_every_special_character_is_escaped() -> None:
    assert latex_text(r"50 % & $1 #2 a_b {c} \d ~ ^ [x]") == (
        r"50 \% \& \$1 \#2 a\_b \{c\} \textbackslash{}d \textasciitilde{} \textasciicircum{} {[}x]"
    )
    assert latex_text("a → b ± 1\n--csls") == r"a $\rightarrow$ b $\pm$ 1 -{}-csls"
    assert latex_text("*a --- b") == "{*}a -{}-{}- b"


def test_rows_have_the_columns_of_the_head_and_sentences_after_them_are_a_comment() -> None:
    table = TextTable(("model", "R@1"), [("[a] & b", "50.0"), ("c_d", "60.0")])
    latex = latex_page([TableSection("A & B", (table,), "In %.", "Behind\n\\input{it}.")])
    assert columns(latex) == [[2, 2, 2, 2]]
    assert r"\caption{A \& B. In \%.}" in latex
    assert "\n% Behind \\input{it}.\n" in latex


def test_reproduced_tables_have_the_columns_of_the_markdown() -> None:
    rows = (row_record("LPN, 90°", {"seed 0": [49.0, 55.1]}, paper=(75.93, 79.14)), row_record("SAFA_x", {}))
    record = TableRecord("table4", "Table IV", ("drone → satellite R@1", "AP"), (0, 1), rows, ("100 % measured.",))
    latex = latex_page([TableSection(record.title, (report.text_table(record),))])
    assert columns(latex) == [[5, 5, 5, 5]]
    assert "| LPN, 90° | 49.00 | 75.93 | 55.10 | 79.14 |" in report.markdown(record)
    assert r"LPN, 90$^{\circ}$ & 49.00 & 75.93 & 55.10 & 79.14 \\" in latex


def test_compare_writes_latex(data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("two.tex", "page.tex")]
    model, more = str(model_file), ["--resamples", "20"]
    compared = ["compare", model, str(one_part_model_file), "--data", str(data), *more]
    assert main([*compared, "--table", str(files[0])]) == 0
    assert main([*compared, "--page", str(files[1])]) == 0
    counts = [columns(file.read_text("utf-8")) for file in files]
    assert len(counts[0]) == 2
    assert len(counts[1]) > 3
    captions = re.findall(r"\\caption\{(.*)\}", files[0].read_text("utf-8"))
    assert captions[1] == f"{captions[0]} Paired tests."
    for tables in counts:
        for table in tables:
            assert len(set(table)) == 1
            assert len(table) > 2
