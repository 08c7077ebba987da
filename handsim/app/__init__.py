"""The application around the commands.

- command_table: the table of commands, each loaded when it is called
- cli: the command `handsim`, its errors and exit codes
- presets: commands whose defaults come from a preset
- demo: what the steps of `handsim demo` share
- messages: lines as they are, and warnings as lines
- progress: the progress bar of all commands
- interrupts: Ctrl-C as a flag that a loop reads
- workers: numbered jobs in worker processes
- system_packages: names of system packages that pip cannot install
- page: one HTML page of pictures and figures
"""
