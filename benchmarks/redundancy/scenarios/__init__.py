"""The scenarios: every file here has one SCENARIO."""
