"""Reports of an examination of a node or of a master: `conform` and `judge` make them, people and CI read them.

A `Report` has one `ReportRow` for each point or rule, with its `Verdict`, and what stands round them: the device, the
bench, what was left out and why, manual steps, times that were measured. What comes in are rows and texts; what goes
out are files and text:

    report = Report("conform", "drive.eds at node 5", facts={"device name": "P4", "firmware": "1.2"})
    report.rows.append(ReportRow("sdo", "10 write ro", Verdict.PASS, clause="CiA 301 7.2.4.3"))
    write_json(report, Path("report.json"))
    print(closing_text(report, compare(report, read_json(Path("before.json")))))

Invariants: what a device sent may hold any byte, and every writer escapes it; names of rows are stable from run to
run, as baselines and the history of a CI server know a row by them; nothing here opens a bus or knows what was asked.

    report      the rows, the report, its exit status
    baseline    comparison with an older report: worse, better, new, gone
    json_file   the document, written and read
    junit       JUnit XML for GitLab, Jenkins and GitHub
    page        one HTML file for people, which loads nothing
    text        lines of a terminal, and the step summary of GitHub

Only the standard library is used. Start reading at `report`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:  # for type checkers, which do not read the table
    from canprobe.fieldbus.tools.reports.baseline import ReportChange as ReportChange
    from canprobe.fieldbus.tools.reports.baseline import compare as compare
    from canprobe.fieldbus.tools.reports.json_file import read_json as read_json
    from canprobe.fieldbus.tools.reports.json_file import report_document as report_document
    from canprobe.fieldbus.tools.reports.json_file import write_json as write_json
    from canprobe.fieldbus.tools.reports.junit import write_junit as write_junit
    from canprobe.fieldbus.tools.reports.page import write_html as write_html
    from canprobe.fieldbus.tools.reports.report import Report as Report
    from canprobe.fieldbus.tools.reports.report import ReportRow as ReportRow
    from canprobe.fieldbus.tools.reports.report import Verdict as Verdict
    from canprobe.fieldbus.tools.reports.text import append_step_summary as append_step_summary
    from canprobe.fieldbus.tools.reports.text import closing_text as closing_text
    from canprobe.fieldbus.tools.reports.text import row_text as row_text
    from canprobe.fieldbus.tools.reports.text import verdict_text as verdict_text

__getattr__, __dir__, __all__ = door(
    __name__,
    {
        "tools.reports.baseline": ("ReportChange", "compare"),
        "tools.reports.json_file": ("read_json", "report_document", "write_json"),
        "tools.reports.junit": ("write_junit",),
        "tools.reports.page": ("write_html",),
        "tools.reports.report": ("Report", "ReportRow", "Verdict"),
        "tools.reports.text": ("append_step_summary", "closing_text", "row_text", "verdict_text"),
    },
)
