"""The public benchmark: simulated captures for all, and a score of anybody's results.

`difficulties`: what makes a capture easy, medium or hard, and the captures of a benchmark.
`making`: makes the captures and their truth.
`manifest`: what a benchmark's folder holds, with checksums; compares it with the published one.
`answers`: labels, joints and angles of one capture, as the truth and results hold them.
`results`: reads what participants write.
`scoring`: counts results against the truth.
"""
