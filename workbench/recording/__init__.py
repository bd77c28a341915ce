"""Episodes: gathered as columns, written as one ``.rrd`` a file, read back and opened in rerun."""
