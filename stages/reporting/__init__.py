"""The parts of the report: artifacts in, what its template needs out."""
