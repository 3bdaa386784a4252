"""What a page of the viewer carries, taken out of its text; and what holds of every one."""

import base64
import hashlib
import json
import re
import zlib


def carried(page: str) -> bytes:
    """The bytes of the asset in a page."""
    parts = re.findall(r'<script type="text/plain" data-part>([A-Za-z0-9+/=]*)</script>', page)
    return zlib.decompress(b"".join(base64.b64decode(part) for part in parts), -15)


def facts(page: str) -> dict[str, object]:
    found = re.search(r'<script id="facts" type="application/json">(.*?)</script>', page, re.DOTALL)
    out: dict[str, object] = json.loads(found[1])
    return out


def check_policy(page: str) -> None:
    """Its policy allows its own script and style, by their digests, and images of its own data."""
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data: blob:"

    def digest(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    (style,), (script,) = re.findall(r"<style>(.*?)</style>", page, re.DOTALL), re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert (rules["style-src"], rules["script-src"]) == (digest(style), digest(script))
    assert not re.search(r"""\s(on\w+|style)=["']""", page.replace(script, ""))  # they would be refused


def check_no_other_place(page: str) -> None:
    """It names no address, and its script has nothing that sends a request or runs a text."""
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert not re.search(r"(https?:)?//[a-z0-9-]+\.[a-z]", page, re.IGNORECASE)
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|EventSource|importScripts|sendBeacon|eval|innerHTML)\b", script)
    assert not re.search(r"""\b(src|href|action)=["'](?!data:)""", page.replace(script, ""))
