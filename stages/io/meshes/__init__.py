"""What mesh files hold, whoever wrote them: shape alone, read in a time and a memory that grow with the file's size and with nothing that it says."""
