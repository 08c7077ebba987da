"""The page on a take: what a biomechanics lab looks at before it uses the angles.

- hand_figures: angles, residuals and presence of markers of each hand, and their statistics.
- take_plots: the pictures: angles, residuals and presence over time.
- take_page: the HTML page.
- take_tables: its tables, as .csv.
"""
