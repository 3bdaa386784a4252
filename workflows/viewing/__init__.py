"""A run or an asset in a browser: its viewer page, and a server that shows it, and a run while it is made, on this machine or through a tunnel."""
