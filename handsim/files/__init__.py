"""Files, written whole or not at all.

- atomic: a temporary path that takes its name at the end, and reading of TOML
- capacity: free space on the disk and memory, asked for before the work
- arrays: `.npz` archives with their sizes checked first
- inputs: what others wrote, read only from regular files of a bounded size
- json_files: JSON objects, and folders claimed by a settings file
- outputs: a check that no output is written over an input
- toml_values: type checks and formatting of TOML values
"""
