#!/bin/sh
# A fleet on this machine, two stages at a time. The same command again goes on where it ended.
set -eu
cd "$(dirname "$0")"
enerf fleet scenes.toml --root .. --out "${1:-fleet}" --jobs 2
