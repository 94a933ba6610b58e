"""The 3-D view as a browser meets it: served by a process, fed live, and opened from a disk."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
import viser
from msgspec import msgpack
from patience import patience_s
from websockets.sync.client import connect
from zstandard import ZstdDecompressor

import canprobe
from canprobe.cell.results.result import write_page_of
from canprobe.cell.scene.model import BridgeSettings
from canprobe.cli import main
from canprobe.errors import install_line

ROOT = Path(__file__).parents[3]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def page_at(address):
    with urllib.request.urlopen(address, timeout=patience_s(20)) as answer:
        assert answer.status == 200
        return answer.read().decode()


def messages(address, wanted, feed=lambda: None):
    """Names of nodes, types of messages that a server tells a browser first, until the wanted ones have come.

    A plain client that names viser's protocol. Each packet: two sizes, msgpack under zstd, then raw arrays. What feeds
    the server goes on meanwhile, as a cell does: a live page draws what is newest when there is something new.
    """
    found = set()
    ends = time.monotonic() + 120.0
    with connect(address.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as client:
        while not wanted <= found:
            assert time.monotonic() < ends, wanted - found
            feed()
            try:
                packet = client.recv(timeout=0.1)
            except TimeoutError:
                continue
            size, length = (int.from_bytes(packet[i : i + 8], "little") for i in (0, 8))
            packed = ZstdDecompressor().decompress(packet[16 : 16 + length], max_output_size=size)
            for message in msgpack.decode(packed)["messages"]:
                found |= {message["type"], message.get("name")}
    return found


def port_is_free(address):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", int(address.rsplit(":", 1)[1]))) != 0


@pytest.fixture
def served(recorded):
    """`canprobe view RUN_DIR` in a process, and its address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "canprobe", "view", str(recorded.folder), "--port", "0", "--no-open"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    yield process, re.match(r"http://127\.0\.0\.1:\d+", process.stdout.readline())[0]
    process.kill()
    process.communicate()


def test_a_run_is_served_until_it_is_told_to_end(served):
    process, address = served
    assert "<title>Viser</title>" in page_at(address)
    messages(address, {"/arm/3/simple_6_1", "/object/ghost", "/path/000", "GuiSliderMessage", "GuiUplotMessage"})
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=patience_s(30))
    assert (process.returncode, out, err) == (0, "", "")
    assert port_is_free(address)
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)


def test_a_cell_is_shown_while_it_runs(recorded, bridge_of):
    """The bridge, fed what an observer saw: a browser finds the path, nothing is dropped, nothing is left."""
    scene = replace(recorded.result.plan.scene, bridge=BridgeSettings(use=("view",), view_port=0))
    bridge = bridge_of("view", canprobe.plan(scene))
    address = bridge.await_ready()
    for observation in recorded.observations:
        bridge.observe(observation)
    assert "<title>Viser</title>" in page_at(address)
    last = recorded.observations[-1]
    wanted = {"/arm/6", "/path/0000", "/probe/taxels", "GuiUplotMessage"}
    messages(address, wanted, lambda: bridge.observe(last))
    status = bridge.end("{}")
    assert (status["error"], status["dropped"]) == (None, 0) and status["samples"] >= len(recorded.observations)
    assert port_is_free(address)


def test_a_scene_becomes_one_file_though_a_folder_is_called_like_it(tmp_path, monkeypatch, capsys):
    (tmp_path / "free").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["view", "free", "--html", "free.html", "--out", "run", "--duration", "0.1"]) == 0
    assert capsys.readouterr().out == "free.html\n" and "__VISER_EMBED_DATA__" in Path("free.html").read_text("utf-8")
    assert main(["view", "./free", "--html", "free.html"]) == 2
    said = "no scene.toml in this folder; expected one that `canprobe run --out DIR` wrote"
    assert said in capsys.readouterr().err
    assert main(["view", "free", "--port", "70000"]) == 2
    assert "expected an integer from 0 to 65535" in capsys.readouterr().err


def test_without_the_extra_there_is_the_line_that_installs_it(monkeypatch, capsys, recorded):
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None if name == "viser" else find(name, *rest))
    assert main(["view", str(recorded.folder)]) == 2
    line = install_line("view")
    assert re.fullmatch(r"pip install (-e )?'.+\[view\]'", line)
    assert capsys.readouterr().err == f"canprobe: view: needs viser; type: {line}\n"


@pytest.fixture
def chromium(tmp_path):
    """A page of a headless Chromium that can resolve no host name, as a function of (method, parameters)."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here; apt-get install chromium")
    browser = subprocess.Popen(
        [
            CHROMIUM, "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
            "--window-size=640,300", "--remote-debugging-port=0", f"--user-data-dir={tmp_path / 'profile'}",
            "about:blank",
        ],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        port = next(m[1] for line in browser.stderr if (m := re.search(r"listening on ws://127\.0\.0\.1:(\d+)", line)))
        pages = json.loads(page_at(f"http://127.0.0.1:{port}/json"))
        url = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
        with connect(url, max_size=None) as client:
            yield lambda method, **parameters: call(client, method, parameters)
    finally:
        os.killpg(browser.pid, signal.SIGKILL)
        browser.communicate()


def call(client, method, parameters):
    """One call of the DevTools protocol: its answer, and the addresses that were asked for meanwhile."""
    client.send(json.dumps({"id": 1, "method": method, "params": parameters}))
    asked = []
    while True:
        document = json.loads(client.recv(timeout=patience_s(60)))
        if document.get("method") == "Network.requestWillBeSent":
            asked.append(document["params"]["request"]["url"])
        if document.get("id") == 1:
            return document["result"], asked


@pytest.mark.slow(reason="starts a browser")
@pytest.mark.timeout(600)  # a browser on a busy machine
def test_the_page_plays_in_chromium_and_asks_for_nothing(chromium, recorded):
    """Opened from the disk; the panel follows the slider, which moves by itself.

    The scene lies outside the window, where viser does not draw it: without a graphics card that takes minutes.
    """
    write_page_of(recorded.folder, recorded.result.plan.setup)
    address = (recorded.folder / "report.html").as_uri()
    chromium("Network.enable")
    chromium("Page.enable")
    style = "<style>#root { transform: translateX(200vw); }</style>"
    hide = f"addEventListener('DOMContentLoaded', () => document.head.insertAdjacentHTML('beforeend', '{style}'))"
    chromium("Page.addScriptToEvaluateOnNewDocument", source=hide)
    _, asked = chromium("Page.navigate", url=address)
    read = "document.querySelector('#canprobe td + td')?.textContent"
    shown = set()
    while len(shown - {None}) < 3:
        result, more = chromium("Runtime.evaluate", expression=read)
        shown.add(result["result"].get("value"))
        asked += more
    assert all(re.fullmatch(r"[\d.]+ s", text) for text in shown - {None})
    second = "getComputedStyle(document.querySelector('#root .mantine-NumberInput-root')).display"
    assert chromium("Runtime.evaluate", expression=second)[0]["result"]["value"] == "none"  # one time on the page
    assert [url for url in asked if not url.startswith(("data:", "blob:")) and url != address] == []
