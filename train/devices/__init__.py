"""Training on many devices: which process this is, its devices, and what the processes agree about.

- world: how many processes train together and which one this is, as the environment says.
- fabric_start: the devices of this process, joined with those of the others.
- agreement: errors and signals that one process meets end all of them, and one of them tells.
- local_processes: processes on this machine, one a device, that end with the one that started them.
"""
