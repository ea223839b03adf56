"""``coliags view`` as a process."""

from __future__ import annotations

import signal
import subprocess
import sys
import urllib.request

import pytest

pytest.importorskip("viser")


@pytest.mark.parametrize("number", [signal.SIGINT])
def test_ctrl_c_ends_it_cleanly(anchors, number, request):
    before = signal.signal(number, signal.default_int_handler)  # a background job ignores it, and so would the process
    request.addfinalizer(lambda: signal.signal(number, before))
    command = [sys.executable, "-c", "from coliags_plugin.cli import main; main()", "view", str(anchors.path)]
    process = subprocess.Popen(
        [*command, "--port", "0", "--no-open"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    line = process.stdout.readline()
    with urllib.request.urlopen(line.split()[0], timeout=20) as answer:
        assert answer.status == 200
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out == "ended\n" and "Traceback" not in err and "server" not in err
