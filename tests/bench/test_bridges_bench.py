"""The study of bridges: a short one measures what it says, and sizes are those of the files."""

from pathlib import Path

import bridges_bench as bridges
import mcap
import pytest
from bridges_bench import size_of

from canprobe.lab.studies.result import text_of


@pytest.mark.slow(reason="a measurement of bridges")
def test_a_short_study_has_a_row_a_case(monkeypatch):
    monkeypatch.setattr(bridges, "QUICK_SECONDS", 0.1)
    monkeypatch.setattr(bridges, "WARM_UP", 20)
    monkeypatch.setattr(bridges, "SCENE", "free")
    monkeypatch.setattr(bridges, "CASES", bridges.CASES[:2])
    result = bridges.run(quick=True, sweep=None)
    none, fed = result.rows
    assert (none["bridge"], none["samples"], none["processor_percent"]) == ("none", 0, None)
    assert fed["bridge"] == "mcap" and fed["error"] is None
    assert fed["samples"] == result.facts["cycles"] > 50
    assert fed["added_p50_us"] > none["added_p50_us"] > 0
    assert fed["processor_percent"] >= 0 and fed["installed_mb"] > 1 and none["installed_mb"] == 0
    assert "dropped in all" in text_of(result)


@pytest.mark.slow(reason="a measurement of bridges")
def test_a_size_counts_every_file_once_and_leaves_out_what_is_there_anyway():
    """mcap alone has its own files, and lz4 and zstandard, whose names differ from their imports."""
    own = sum(path.stat().st_size for path in Path(mcap.__file__).parent.rglob("*.py"))
    assert size_of({"mcap"}) > own
    assert size_of({"mcap"}) == size_of({"mcap"})
    assert size_of({"numpy"}) == size_of({"can", "scipy"}) == size_of({"nothing_of_the_kind"}) == 0
    assert size_of({"rosbags", "mcap"}) == pytest.approx(size_of({"mcap", "rosbags"}))
