"""How a browser takes the pages that the program writes: one JSON object for each.

    python benchmarks/pages.py PAGE.html… [--chromium chromium] [--repeats 3]

opens each in Chromium without a window, over its protocol for developers. `messages` are those of its console
and its log, exceptions too: there should be none. `drawn_s` is the time from the start of loading until the
page is loaded and its next frame is drawn, the middle one of the repeats, without the browser's own start.
Nothing is loaded from the network: what would be stands in `messages`.
"""

import argparse
import asyncio
import contextlib
import itertools
import json
import shutil
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

_STARTS_WITHIN_S = 60.0
_DRAWN = """new Promise(done => {
    const drawn = () => requestAnimationFrame(() => requestAnimationFrame(() => done({
        drawn_s: performance.now() / 1e3,
        pictures: document.images.length})));
    if (document.readyState === "complete") drawn(); else addEventListener("load", drawn);
})"""
_QUIET_S = 0.3  # after which nothing more is said


class Tab:
    """A page of the browser, and what it has said."""

    def __init__(self, connection: WebSocketClientConnection) -> None:
        self._connection = connection
        self._numbers = itertools.count(1)
        self.messages: list[str] = []

    async def call(self, method: str, **parameters: Any) -> Any:
        """Return what a command gives; note what is said meanwhile."""
        number = next(self._numbers)
        await self._connection.write_message(
            json.dumps({"id": number, "method": method, "params": parameters})
        )
        while True:
            text = await self._connection.read_message()
            if text is None:
                raise SystemExit("the browser has gone: open the page in it by hand to see why")
            told = json.loads(text)
            if told.get("id") == number:
                return told.get("result", told)
            self._note(told)

    async def listen(self) -> None:
        """Note what is said until nothing is for a while."""
        with contextlib.suppress(asyncio.TimeoutError):
            while True:
                text = await asyncio.wait_for(self._connection.read_message(), _QUIET_S)
                self._note(json.loads(text or "{}"))

    def _note(self, told: dict[str, Any]) -> None:
        said = told.get("params", {})
        match told.get("method"):
            case "Network.requestWillBeSent":
                address = said["request"]["url"]
                if not address.startswith(("file:", "data:", "blob:")):
                    self.messages.append(f"network: {address}")
            case "Log.entryAdded":
                entry = said["entry"]
                self.messages.append(f"{entry['level']}: {entry['text']} {entry.get('url', '')}".strip())
            case "Runtime.consoleAPICalled":
                words = [str(one.get("value", one.get("description"))) for one in said["args"]]
                self.messages.append(f"{said['type']}: {' '.join(words)}")
            case "Runtime.exceptionThrown":
                details = said["exceptionDetails"]
                self.messages.append(
                    f"exception: {details.get('exception', {}).get('description', details['text'])}"
                )


async def opened(port: int, page: Path) -> dict[str, Any]:
    """Open a page in a tab of its own; return what came of it."""
    browser = Tab(await websocket_connect(_browser_url(port)))
    target = (await browser.call("Target.createTarget", url="about:blank"))["targetId"]
    # Pages hold their pictures: 1 GiB is more than any has.
    tab = Tab(
        await websocket_connect(f"ws://127.0.0.1:{port}/devtools/page/{target}", max_message_size=2**30)
    )
    for domain in ("Page", "Log", "Runtime", "Network"):
        await tab.call(f"{domain}.enable")
    await tab.call("Page.navigate", url=page.resolve().as_uri())
    facts: dict[str, Any] = {}
    until = time.monotonic() + _STARTS_WITHIN_S
    while "drawn_s" not in facts and time.monotonic() < until:  # a page that just goes takes its answer along
        told = await tab.call(
            "Runtime.evaluate",
            expression=f"location.protocol === 'file:' ? {_DRAWN} : ({{}})",
            awaitPromise=True,
            returnByValue=True,
        )
        facts = told.get("result", {}).get("value") or {}
    await tab.listen()
    await browser.call("Target.closeTarget", targetId=target)
    return {**facts, "messages": tab.messages}


def _browser_url(port: int) -> str:
    from urllib.request import urlopen

    with urlopen(f"http://127.0.0.1:{port}/json/version") as answer:
        return str(json.load(answer)["webSocketDebuggerUrl"])


@contextlib.contextmanager
def browser(program: str) -> Any:
    """Run a browser without a window; yield the port that it listens at."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
        words += [f"--user-data-dir={profile}", "--window-size=1280,1600", "about:blank"]
        running = subprocess.Popen(  # noqa: S603
            [program, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            file, until = Path(profile) / "DevToolsActivePort", time.monotonic() + _STARTS_WITHIN_S
            while not (file.is_file() and file.read_text().strip()):
                if running.poll() is not None or time.monotonic() > until:
                    raise SystemExit(f"{program}: does not start; is it a Chromium?")
                time.sleep(0.1)
            yield int(file.read_text().split()[0])
        finally:
            running.terminate()
            running.wait()


def main() -> None:
    """Open the pages, and print what came of each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="*", type=Path)
    parser.add_argument("--chromium", default="chromium")
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    program = shutil.which(asked.chromium)
    if not asked.pages or program is None:
        print(json.dumps({"benchmark": "pages", "skipped": "give pages, and have Chromium installed"}))
        return
    with browser(program) as port:
        for page in asked.pages:
            found = [asyncio.run(opened(port, page)) for _ in range(asked.repeats)]
            record = {
                "benchmark": "pages",
                "page": str(page),
                "bytes": page.stat().st_size,
                "drawn_s": round(statistics.median(one.get("drawn_s", float("inf")) for one in found), 3),
                "pictures": found[0].get("pictures"),
                "messages": sorted({text for one in found for text in one["messages"]}),
            }
            print(json.dumps(record), flush=True)


if __name__ == "__main__":
    main()
