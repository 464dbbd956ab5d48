"""Chromium without a window, driven by the DevTools protocol through a pipe."""

import base64
import json
import os
import shutil
import signal
import subprocess
import time

import pytest

__all__ = ["Browser"]

SECONDS = 60  # until a test gives up on something
#: Key codes of the protocol.
CODES = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}


class Browser:
    """A page. Use it in a `with` block; skips the test where there is no Chromium."""

    def __init__(self, folder, width=1200, height=900):
        path = shutil.which("chromium")
        if path is None:
            pytest.skip("chromium is not installed (Debian: apt install chromium)")
        reads, self._write = os.pipe()
        self._read, writes = os.pipe()
        self._count, self._rest, self._session = 0, b"", None
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe"]
        options += [f"--user-data-dir={folder}/chromium", f"--window-size={width},{height}"]
        # the protocol's ends are the file descriptors 3 and 4
        self._process = subprocess.Popen(
            ["bash", "-c", f'exec "$0" "$@" 3<&{reads} 4>&{writes}', path, *options],
            pass_fds=(reads, writes),
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(reads)
        os.close(writes)
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        attached = self.send("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]

    def __enter__(self):
        return self

    def __exit__(self, *error):
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def send(self, method, **params):
        """Calls a method of the protocol. Returns its result."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        message |= {"sessionId": self._session} if self._session else {}
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]

    def _receive(self):
        while b"\0" not in self._rest:
            part = os.read(self._read, 1 << 16)
            assert part, "Chromium has ended"
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def value(self, expression):
        """Returns what JavaScript evaluates to."""
        result = self.send(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, expression):
        """Waits until JavaScript is true."""
        end = time.monotonic() + SECONDS
        while not self.value(expression):
            assert time.monotonic() < end, f"{expression} never was"
            time.sleep(0.01)

    def key(self, key, is_down):
        """Presses or releases a key."""
        code = CODES.get(key, ord(key[0].upper()))
        kind = "keyDown" if is_down else "keyUp"
        self.send("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code)

    def screenshot(self):
        """Returns a PNG of the page."""
        return base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])
