"""What pages of assets and of fleets share: texts within HTML, and the size up to which an asset gets a page."""

import base64
import hashlib
import json
from typing import Any

MAX_ASSET = 192_000_000  # bytes of an asset that a page is made of by itself: its textures fill what a graphics card of 1 GB has for them


def policy_hash(text: str) -> str:
    """As a Content-Security-Policy names a script."""
    return base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")


def json_for_html(value: Any) -> str:
    """JSON that ends no element and begins no comment, whatever its texts hold."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
