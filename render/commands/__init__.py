"""The commands `handsim glove` and `handsim render`.

- glove: `glove list`, `show`, `new` and `check`.
- render: `render`, with its options.
- demo: the steps of `handsim demo` that draw.
"""
