"""The application around the commands.

- command_table: the table of commands, each loaded when it is called
- cli: the command `handsim`, its errors and exit codes
- completion: a script that completes commands and options in a shell
- presets: commands whose defaults come from a preset
- demo: what the steps of `handsim demo` share
- memory: refuses work that the machine has no memory for
- messages: lines as they are, and warnings as lines
- progress: the progress bar of all commands, and lines in its place in a log
- live_status: one line of status, renewed in place
- interrupts: signals to end, as a flag that a loop reads or as an exception
- workers: numbered jobs in processes of this machine, or on another executor
- cluster: the workers of a Dask scheduler as an executor
- output: where jobs leave their files: a folder, or an object store
- system_packages: names of system packages that pip cannot install
- page: one HTML page of pictures and figures
"""
