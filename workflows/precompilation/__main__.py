"""`python -m workflows.precompilation`, the last step of `make install`: begins to compile the kernels of the usual settings in the background."""

from workflows.precompilation.start import start_alone

if __name__ == "__main__":
    start_alone()
