import os

# onnxruntime, wherever it is imported, else keeps an identifier of the device in the user's cache and sends to its maker what it is used for.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
