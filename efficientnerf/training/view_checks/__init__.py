"""Whether the training views' cameras are right, by what the field shows."""
