"""A self-contained HTML file about some queries: pictures inside, no network, no script; it prints on A4.

task = lpn.tasks.opening.describe_task(model, "lpn.onnx", dataset)
write_atomic(Path("report.html"), lpn.report.build(task, [17, 4]))
"""

from lpn.library.analyser import OwnPicture
from lpn.report._rendering import table_page
from lpn.report.cases import Options
from lpn.report.page import build

__all__ = ["Options", "OwnPicture", "build", "table_page"]
