#!/bin/sh
# A fleet on two machines that share FLEET. Name them in ssh.toml; ssh reaches them without a password.
# Where workers are started by other means, give the address of their scheduler: --scheduler tcp://first.example.org:8786
set -eu
cd "$(dirname "$0")"
enerf fleet scenes.toml --root .. --out "${1:?the folder of the fleet, on storage that all machines share}" --cluster ssh --cluster-options ssh.toml
