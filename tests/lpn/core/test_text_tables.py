"""Tables of text: each form's escapes, and equal numbers of columns in all rows."""

from __future__ import annotations

import io
import re

from lpn.core.consoles import Console
from lpn.core.text_tables import TextTable, latex_page, latex_text, markdown_page


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
    table = TextTable(("model", "R@1"), [("[a] & b", "50.0"), ("c_d", "60.0")], "A & B. In %", "Behind\n\\input{it}.")
    latex = latex_page([table])
    assert columns(latex) == [[2, 2, 2, 2]]
    assert r"\caption{A \& B. In \%.}" in latex
    assert "\n% Behind \\input{it}.\n" in latex


TABLE = TextTable(
    ("model", "kind", "R@1"),
    [("[red]a[/red]|<b>", "LPN", "50.00"), ("=1+1", "SAFA\x1b[1m", "-4.00"), ("mean", "", "23.00")],
    title="[bold]One[/bold]",
    after="[i]In %[/i].",
    align="llr",
    ruled=(2,),
)


def test_a_terminal_shows_each_cell_as_it_is_and_a_line_above_a_ruled_row() -> None:
    console = Console(width=80, file=io.StringIO())
    TABLE.print(console)
    title, _, head, _, *rows, after = console.file.getvalue().splitlines()
    assert (title.strip(), after) == ("[bold]One[/bold]", "[i]In %[/i].")
    cells = [[cell.strip() for cell in row.strip("│┃").replace("┃", "│").split("│")] for row in (head, *rows)]
    assert cells[0] == list(TABLE.head)
    assert cells[1] == list(TABLE.rows[0])
    assert cells[2] == ["=1+1", "SAFA?[1m", "-4.00"]
    assert rows[2].startswith("├")
    assert cells[4] == ["mean", "", "23.00"]
    assert all(row.index(number) == rows[0].index("50.00") for row, number in ((rows[3], "23.00"), (rows[0], "50.00")))


def test_markdown_html_and_csv_escape_cells_and_keep_their_order() -> None:
    assert markdown_page([TABLE], "A|B").splitlines() == [
        *("# A\\|B", "", "## [bold]One[/bold]", "", "| model | kind | R@1 |", "| --- | --- | ---: |"),
        *("| [red]a[/red]\\|&lt;b&gt; | LPN | 50.00 |", "| =1+1 | SAFA?[1m | -4.00 |", "| mean |  | 23.00 |"),
        *("", "[i]In %[/i].", ""),
    ]
    page = str(TABLE.html())
    assert page.startswith('<table><thead><tr><th scope="col">model</th><th scope="col">kind</th>')
    assert '<th scope="col" class="r">R@1</th></tr></thead>' in page
    assert '<tr><th scope="row">[red]a[/red]|&lt;b&gt;</th><td>LPN</td><td class="r">50.00</td></tr>' in page
    assert TABLE.csv().decode().splitlines() == [
        *("model,kind,R@1", "[red]a[/red]|<b>,LPN,50.00", "'=1+1,SAFA?[1m,-4.00", "mean,,23.00")
    ]
