"""OSC bundles, as python-osc reads them."""

from __future__ import annotations

import dataclasses

import numpy as np
from pythonosc.osc_bundle import OscBundle

from track.sinks.osc_bundles import OscEncoder

ENCODER = OscEncoder()


def read(datagram: bytes) -> dict[str, list]:
    assert OscBundle.dgram_is_bundle(datagram)
    return {one.address: list(one.params) for one in OscBundle(datagram)}


def test_a_frame(message):
    one = message(7)
    got = read(ENCODER.frame(one))
    assert got.pop("/handsim/frame") == [7, one.time, 0]
    for hand in one.hands:
        assert got.pop(f"/handsim/{hand.side}/status") == ["tracked"]
        wrist = [*hand.position, *hand.quaternion]
        np.testing.assert_array_equal(got.pop(f"/handsim/{hand.side}/wrist"), np.float32(wrist))
        np.testing.assert_array_equal(got.pop(f"/handsim/{hand.side}/angles"), np.float32(hand.angles))
        positions = np.reshape(got.pop(f"/handsim/{hand.side}/positions"), (21, 3))
        np.testing.assert_array_equal(positions, np.float32(hand.positions))
    assert got.pop("/handsim/body/mug/status") == ["tracked"]
    np.testing.assert_allclose(got.pop("/handsim/body/mug/pose"), [0.1, 0.2, 0.3, 1, 0, 0, 0], rtol=1e-6)
    assert not got


def test_of_a_lost_hand_only_the_status_is_sent(message):
    got = read(ENCODER.frame(message(lost=True)))
    assert got["/handsim/left/status"] == got["/handsim/body/mug/status"] == ["lost"]
    assert [address for address in got if "left" in address or "mug" in address] == [
        "/handsim/left/status",
        "/handsim/body/mug/status",
    ]


def test_the_names(message):
    header = message().header
    got = read(ENCODER.header(header))
    assert got["/handsim/schema"] == [1] and got["/handsim/sides"] == ["right", "left"]
    assert got["/handsim/angles"] == list(header.angles)
    assert got["/handsim/positions"] == list(header.positions)
    assert got["/handsim/bodies"] == ["mug"]


def test_names_of_bodies_become_parts_of_addresses(message):
    one = message()
    odd = dataclasses.replace(one.bodies[0], name="my pen #2/ä")
    got = read(ENCODER.frame(dataclasses.replace(one, bodies=(odd,))))
    assert "/handsim/body/my_pen__2__/status" in got


def test_a_late_number_is_one_of_osc_s(message):
    assert read(ENCODER.frame(message(2**31 + 5)))["/handsim/frame"][0] == 5


def test_two_hands_fit_into_one_packet_of_ethernet(message):
    assert len(ENCODER.frame(message())) < 1472
