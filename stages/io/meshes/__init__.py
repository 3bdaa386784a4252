"""The contents of untrusted mesh files: shape alone, read in a time and a memory that grow with the file's size and nothing else."""
