"""Reports: what each reader of a file takes from it, with every byte that a device may have sent."""

import html.parser
import json
import os
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.errors import UsageError
from canprobe.fieldbus.tools.reports import (
    Report,
    ReportRow,
    Verdict,
    append_step_summary,
    closing_text,
    compare,
    read_json,
    report_document,
    row_text,
    verdict_text,
    write_html,
    write_json,
    write_junit,
)

ANY_TEXT = st.text(st.characters(codec=None) | st.sampled_from("\x00\x1b\r\n\t<&|\ud800\uffff"), max_size=20)
ROWS = st.builds(
    ReportRow,
    group=st.sampled_from(["sdo", "nmt"]) | ANY_TEXT,
    name=ANY_TEXT,
    verdict=st.sampled_from(Verdict),
    clause=ANY_TEXT,
    detail=ANY_TEXT,
    sent=st.lists(ANY_TEXT, max_size=2).map(tuple),
    came=st.lists(ANY_TEXT, max_size=2).map(tuple),
)


def example():
    """A report with a row of each verdict."""
    came = ("581 80 00 10 00 02 00 01 06  abort 06010002h of 1000h",)
    return Report(
        "conform",
        "drive.eds at node 1",
        {"vendor": "0000002Ah", "product": "00000402h", "device name": "P4 <drive>", "firmware": "1.2"},
        [
            ReportRow("nmt", "1 boot-up", Verdict.PASS, "CiA 301 7.2.8.3.3", seconds=0.5),
            ReportRow("sdo", "10 write ro", Verdict.PASS, "CiA 301 7.2.4.3", came=came, written=("1000h: restored",)),
            ReportRow(
                *("sdo", "11 below min", Verdict.FAIL, "CiA 301 7.2.4.3", "abort 06090032h or 06090030h"),
                sent=("601 2B 17 10 00 00 00 00 00",),
                came=("581 60 17 10 00 00 00 00 00",),
                detail="the write of a value below the least one was accepted",
                hint="refuse values below LowLimit of the EDS",
                severity="wrong",
            ),
            ReportRow("sdo", "12 segmented write", Verdict.NOT_APPLICABLE, detail="no object is long enough"),
            ReportRow("pdo", "30 type 1", Verdict.ERROR, detail="the bus was off"),
        ],
        left_out=[("SYNC points", "another SYNC producer is on the bus")],
        manual=["switch the supply off and on"],
        distributions={"SDO": (0.2, 0.3, 0.25, 1.0), "heartbeat": (100.0,)},
        log="conform.log",
    )


class Cases(dict):
    """Cases of a JUnit file by (class name, name), as GitLab reads them: verdict and its text, then system-out."""

    def __init__(self, path):
        for case in ElementTree.parse(path).iter("testcase"):
            verdict = next(
                (case.find(tag) for tag in ("failure", "error", "skipped") if case.find(tag) is not None), None
            )
            texts = (None, "") if verdict is None else (verdict.tag, verdict.text or verdict.get("message"))
            assert float(case.get("time")) >= 0
            key = (case.get("classname"), case.get("name"))
            assert key not in self, "GitLab drops equal names"
            self[key] = (*texts, case.findtext("system-out", ""))


def test_junit_has_all_that_ci_servers_show_in_names_failure_texts_and_system_out(tmp_path):
    report = example()
    write_junit(report, tmp_path / "junit.xml")
    cases = Cases(tmp_path / "junit.xml")
    assert {key: case[0] for key, case in cases.items()} == {
        ("canprobe.conform.nmt", "1 boot-up"): None,
        ("canprobe.conform.sdo", "10 write ro"): None,
        ("canprobe.conform.sdo", "11 below min"): "failure",
        ("canprobe.conform.sdo", "12 segmented write"): "skipped",
        ("canprobe.conform.pdo", "30 type 1"): "error",
    }
    _, text, out = cases["canprobe.conform.sdo", "11 below min"]
    for part in ("the write of", "(wrong)", "7.2.4.3", "06090032h", "601 2B 17", "581 60 17", "LowLimit"):
        assert part in text, text
    assert "sent: 601 2B 17 10 00" in out
    assert out.endswith(f"[[ATTACHMENT|{os.path.abspath('conform.log')}]]")
    assert "ATTACHMENT" not in cases["canprobe.conform.sdo", "10 write ro"][2]

    root = ElementTree.parse(tmp_path / "junit.xml").getroot()
    totals = {"name": "canprobe conform", "tests": "5", "failures": "1", "errors": "1", "time": "0.500"}
    assert root.attrib == totals, "Jenkins allows no others"
    assert [suite.get("skipped") for suite in root] == ["0", "1", "0"]
    assert [suite.get("name") for suite in root] == [f"canprobe.conform.{one}" for one in ("nmt", "sdo", "pdo")]
    assert root.find(".//failure").get("type") == "CiA 301 7.2.4.3"


def test_equal_names_stay_apart_and_long_rows_are_cut(tmp_path):
    row = ReportRow("enable", "1 jump", Verdict.FAIL, came=tuple(map(str, range(100_000))))
    write_junit(Report("judge", "a master", rows=[row, row]), tmp_path / "junit.xml")
    cases = Cases(tmp_path / "junit.xml")
    assert [name for _, name in cases] == ["1 jump", "1 jump (2)"]
    assert "99800 more frames" in cases["canprobe.judge.enable", "1 jump"][1]


class Page(html.parser.HTMLParser):
    """The texts of a page, whether its tags match, and what it would load."""

    def __init__(self, path):
        super().__init__()
        self.open, self.texts, self.loads, self.opened = [], [], [], 0
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "rect"):
            self.open.append(tag)
        self.loads += [value for name, value in attrs if name in ("src", "href")]
        self.opened += tag == "details" and ("open", None) in attrs

    def handle_endtag(self, tag):
        assert tag == "rect" or self.open.pop() == tag

    def handle_data(self, data):
        assert self.open[-1:] == ["style"] or "url(" not in data
        self.texts.append(data)


def test_the_page_says_all_and_loads_nothing(tmp_path):
    report = example()
    write_html(report, tmp_path / "report.html", compare(report, report))
    page = Page(tmp_path / "report.html")
    text = "\n".join(page.texts)
    said = [
        "P4 <drive>",
        "as in the baseline",
        "another SYNC producer",
        "supply off",
        "no CiA certificate",
        "1000h: restored",
    ]
    for row in report.rows:
        said += [row.name, row.clause, row.expected, row.detail, row.hint, *row.sent, *row.came]
    assert [part for part in said if part not in text] == []
    assert page.loads == []
    assert page.opened == 2, "the failure and the error"
    assert page.texts[page.texts.index("SDO") + 1 :][:6] == ["4", "0.200", "0.275", "0.895", "0.979", "1.000"]


@given(st.lists(ROWS, max_size=3), ANY_TEXT)
def test_a_device_may_have_sent_any_text(tmp_path_factory, rows, text):
    report = Report("judge", text, {"device name": text}, rows, [(text, text)], [text], {text: (1.0,)}, text)
    place = tmp_path_factory.mktemp("report")
    write_json(report, place / "report.json")
    assert read_json(place / "report.json") == report
    write_junit(report, place / "junit.xml")
    assert len(Cases(place / "junit.xml")) == len(rows)
    write_html(report, place / "report.html")
    Page(place / "report.html")
    append_step_summary(report, {"GITHUB_STEP_SUMMARY": str(place / "summary.md")})
    shown = "\n".join([verdict_text(report), closing_text(report), *map(row_text, rows)])
    assert not [char for char in shown if not char.isprintable() and char not in "\n\t"]


def test_the_text_of_a_row_and_the_closing_table():
    report = example()
    assert row_text(report.rows[1]) == "pass   sdo       10 write ro"
    assert row_text(report.rows[2]).splitlines() == [
        "FAIL   sdo       11 below min",
        "       the write of a value below the least one was accepted [CiA 301 7.2.4.3]",
    ]
    assert closing_text(report).splitlines() == [
        "        pass  FAIL  n/a  ERROR",
        "nmt        1     -    -      -",
        "sdo        1     1    1      -",
        "pdo        -     -    -      1",
        "in all     2     1    1      1",
        "left out: SYNC points: another SYNC producer is on the bus",
        "by hand: switch the supply off and on",
        "log: conform.log",
    ]


def test_the_verdict_comes_in_some_lines():
    report = example()
    assert verdict_text(report, compare(report, report)).splitlines() == [
        "drive.eds at node 1: 1 of 3 points FAIL",
        "2 pass, 1 FAIL, 1 n/a, 1 ERROR",
        "FAIL   sdo 11 below min: the write of a value below the least one was accepted [CiA 301 7.2.4.3]",
        "ERROR  pdo 30 type 1: the bus was off",
        "baseline: as in the baseline",
        "log: conform.log",
    ]
    report = Report("conform", "a device", rows=[ReportRow("sdo", f"{n}", Verdict.FAIL, detail="x") for n in range(9)])
    assert verdict_text(report).splitlines()[-1] == "       and 6 more"
    ended = [ReportRow("sdo", f"{n}", Verdict.ERROR, detail="not examined: the power is on") for n in range(5)]
    assert verdict_text(Report("conform", "a device", rows=ended)).splitlines() == [
        "a device: not examined to the end",
        "5 ERROR",
        "ERROR  sdo 0 (and 4 more): not examined: the power is on",
    ]
    some = [("--eds FILE names it", "1"), ("--motion permits it", "2"), ("--motion permits it", "3")]
    rows = [ReportRow("sdo", name, Verdict.NOT_APPLICABLE, detail=text) for text, name in some]
    rows.append(ReportRow("sdo", "4", Verdict.PASS))
    assert verdict_text(Report("conform", "a device", rows=rows)).splitlines() == [
        "a device: passes, 1 point",
        "1 pass, 3 n/a",
        "more points with: --eds (1), --motion (2)",
    ]


def test_the_exit_status_is_the_worst_that_was_found():
    rows = {verdict: ReportRow("sdo", verdict, verdict) for verdict in Verdict}
    for verdicts, status in (("", 0), ("PASS NOT APPLICABLE", 0), ("PASS ERROR", 3), ("ERROR FAIL", 1)):
        assert Report("conform", "", rows=[rows[one] for one in Verdict if one in verdicts]).exit_status == status


def test_a_baseline_shows_what_became_worse_better_new_and_gone():
    older, report = example(), example()
    report.facts["firmware"] = "1.3"
    report.rows[1] = ReportRow("sdo", "10 write ro", Verdict.FAIL)
    report.rows[2] = ReportRow("sdo", "11 below min", Verdict.PASS)
    report.rows[0] = ReportRow("nmt", "2 reset", Verdict.PASS)
    assert compare(report, older).lines() == [
        "firmware: 1.2 -> 1.3",
        "worse: sdo 10 write ro",
        "better: sdo 11 below min",
        "new: nmt 2 reset",
        "gone: nmt 1 boot-up",
    ]
    assert compare(older, example()).lines() == ["as in the baseline"]
    older.facts["product"] = "00000403h"
    with pytest.raises(UsageError, match="another device: product 00000403h, expected 00000402h"):
        compare(report, older)
    older.tool = "judge"
    with pytest.raises(UsageError, match="expected a report of canprobe conform, got one of canprobe judge"):
        compare(report, older)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: [], "got other JSON"),
        (lambda d: d | {"schema": 2}, "of a newer canprobe: this one reads up to schema 1, got 2"),
        (lambda d: {name: value for name, value in d.items() if name != "rows"}, "'rows' is missing"),
        (lambda d: d | {"rows": [d["rows"][0] | {"verdict": "GOOD"}]}, "'GOOD' is not a valid Verdict"),
        (lambda d: d | {"title": 3}, "expected text, got 3"),
        (lambda d: d | {"rows": [d["rows"][0] | {"severity": "bad"}]}, "severity: expected one of unsafe"),
        (lambda d: d | {"distributions": {"SDO": "12"}}, "expected a list, got '12'"),
        (lambda d: d | {"manual": "wait"}, "expected a list, got 'wait'"),
        (lambda d: d | {"facts": []}, r"expected an object, got \[\]"),
    ],
)
def test_a_file_that_is_no_report_is_refused_with_its_name(tmp_path, change, message):
    path = tmp_path / "report.json"
    path.write_text(json.dumps(change(report_document(example()))))
    with pytest.raises(UsageError, match=message) as raised:
        read_json(path)
    assert str(raised.value).startswith(f"{path}: ")


def test_the_step_summary_is_appended_to_where_github_wants_one(tmp_path):
    path = tmp_path / "summary.md"
    path.write_text("before\n")
    append_step_summary(example(), {})
    append_step_summary(example(), {"GITHUB_STEP_SUMMARY": str(path)}, compare(example(), example()))
    assert path.read_text().splitlines() == [
        "before",
        "### canprobe conform: drive.eds at node 1",
        "",
        "2 pass, 1 FAIL, 1 n/a, 1 ERROR",
        "",
        "- baseline: as in the baseline",
        "",
        "| | point | what was wrong | clause |",
        "| --- | --- | --- | --- |",
        "| FAIL | sdo 11 below min | the write of a value below the least one was accepted | CiA 301 7.2.4.3 |",
        "| ERROR | pdo 30 type 1 | the bus was off |  |",
        "",
    ]
