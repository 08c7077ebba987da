import numpy as np
from numpy.testing import assert_allclose

from handsim.hand.skin.cage_topology import cage_topology
from handsim.hand.skin.weights import cage_weights, strongest_weights
from handsim.hand.topology import NUM_BONES


def test_cage_shares_sum_to_one_and_every_bone_moves_something():
    topology = cage_topology()
    weights = cage_weights(topology)
    assert weights.shape == (topology.num_vertices, NUM_BONES)
    assert weights.min() >= 0.0
    assert_allclose(weights.sum(axis=1), 1.0)
    assert (weights.max(axis=0) > 0.9).all()


def test_strongest_keeps_the_four_largest_in_order():
    weights = np.zeros((2, NUM_BONES))
    weights[0, [3, 5, 7, 9, 11]] = [0.1, 0.4, 0.2, 0.25, 0.05]
    weights[1, 2] = 1.0
    indices, shares = strongest_weights(weights)
    assert indices[0].tolist() == [5, 9, 7, 3]
    assert_allclose(shares[0], np.array([0.4, 0.25, 0.2, 0.1]) / 0.95)
    assert indices[1, 0] == 2
    assert_allclose(shares[1], [1.0, 0.0, 0.0, 0.0])
