"""What a run leaves behind: summary, scores against the truth, files, tables and figures."""
