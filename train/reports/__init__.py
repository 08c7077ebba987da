"""Reports: HTML pages and tables about training sets and training runs.

- plot_style: colors and fonts of all pictures, and pictures as `data:` URIs.
- dataset_page, dataset_plots: the page beside a training set; its pictures.
- run_page, run_plots: the page at the end of a training run; its curves, confusions and reliability.
- model_card: the README of a run's folder, as hubs of models read it.
- hand_plot: accuracy and confusions drawn on the hand.
- flat_hand: the resting hand and its markers as a drawing in the plane.
- name_placement: where the markers' names go in that drawing.
- figures_table: figures as a table on the terminal.
"""
