"""Published data sets and exports of phones, several formats a file."""
