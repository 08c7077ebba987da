"""The commands `handsim glove` and `handsim render`.

- glove: `glove list`, `show`, `new` and `check`.
- render: `RenderOptions`, the options of `render`, and the command.
- demo: the steps of `handsim demo` that draw.
"""
