#!/bin/sh
#SBATCH --job-name=fleet
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=24:00:00
# The fleet's scheduler as a job of its own; it asks Slurm for the workers that slurm.toml describes, and gives them back.
# Submit it with: sbatch slurm.sh FLEET. When its time is over, the same command goes on.
set -eu
cd "${SLURM_SUBMIT_DIR:-$(dirname "$0")}"
exec enerf fleet scenes.toml --root .. --out "${1:?the folder of the fleet, on storage that all nodes share}" --cluster slurm --cluster-options slurm.toml
