"""Reports: tables and figures from result files and arrays, never from a model."""
