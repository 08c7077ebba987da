"""The browser viewer: layouts, rigs, training sets, captures, takes, users and live trackers in a web page.

Nothing here imports viser, the package that serves the page, but `server`, when it starts one.
"""
