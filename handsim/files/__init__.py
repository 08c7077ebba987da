"""Files, written whole or not at all.

- atomic: a temporary path that takes its name at the end, and reading of TOML
- json_files: JSON objects, and folders claimed by a settings file
- outputs: a check that no output is written over an input
- toml_values: type checks and formatting of TOML values
"""
