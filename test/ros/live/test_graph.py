# SPDX-License-Identifier: Apache-2.0
"""The tools of the tests on a real graph do what those tests rely on."""

import signal
from pathlib import Path

import pytest
from graph import Camera, NodeProcess, Peer, private_domain, room_pair
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import Trigger

from msg_adapters import depth_image, rgb_image

STUBBORN = """
import signal, sys, time
signal.signal(signal.SIGINT, lambda *_: print("I stay", flush=True))
print("up", flush=True)
while True:
    time.sleep(0.1)
"""


@pytest.fixture
def domain(tmp_path):
    with private_domain(tmp_path) as domain:
        yield domain


def test_two_peers_find_each_other(domain):
    with Peer(domain, "one") as one, Peer(domain, "two") as two:
        publisher, heard = one.publisher(String, "words"), two.collect(String, "words")
        one.matched(publisher)
        publisher.publish(String(data="hello"))
        two.wait(lambda: heard, what="the word")
        assert heard[0][1].data == "hello"


def test_a_peer_has_room_for_images_whatever_ran_in_this_process_before(domain):
    """Fast DDS reads its profile once per process: a file run earlier, without it, would decide for all."""
    with Peer(domain):
        mapped = [line.split() for line in Path("/proc/self/maps").read_text().splitlines() if "/fastrtps_" in line]
    ends = [[int(end, 16) for end in words[0].split("-")] for words in mapped]
    assert max(end - start for start, end in ends) > 32 * 2**20


def test_two_domains_do_not_hear_each_other(domain, tmp_path):
    with private_domain(tmp_path) as other, Peer(domain) as one, Peer(domain) as friend, Peer(other) as stranger:
        assert other.number != domain.number
        publisher = one.publisher(String, "words")
        by_friend, by_stranger = friend.collect(String, "words"), stranger.collect(String, "words")
        one.matched(publisher)
        for word in "abc":
            publisher.publish(String(data=word))
        friend.wait(lambda: len(by_friend) == 3, what="three words")
        stranger.spin(0.5)
        assert by_stranger == []
        assert publisher.get_subscription_count() == 1


def test_a_service_is_called_and_a_wait_says_what_it_waited_for(domain):
    with Peer(domain) as one:
        response = Trigger.Response(success=True, message="done")
        one.node.create_service(Trigger, "do", lambda request, _: response)
        assert one.call(Trigger, "do", Trigger.Request()).message == "done"
        with pytest.raises(pytest.fail.Exception, match=r"waited 0.1 s for a miracle; diagnostics last seen:\nnone"):
            one.wait(lambda: False, 0.1, "a miracle")


def test_a_node_that_hangs_is_killed_and_shown(domain, tmp_path):
    (tmp_path / "stubborn.py").write_text(STUBBORN)
    environment = domain.environment | {"PYTHONPATH": str(tmp_path)}
    node = NodeProcess([], environment, tmp_path / "log", module="stubborn")
    node.wait_for("up")
    node.signal(signal.SIGINT)
    with pytest.raises(pytest.fail.Exception, match=r"(?s)still runs 0.5 s.*I stay.*stubborn.py"):
        node.wait(0.5)
    assert node.process.returncode is not None


@pytest.mark.parametrize(
    ("code", "said"), [("raise SystemExit(3)", "exit code 3"), ("print('Traceback (most')", "Traceback")]
)
def test_a_node_that_ends_badly_fails_the_test(domain, tmp_path, code, said):
    (tmp_path / "bad.py").write_text(code)
    environment = domain.environment | {"PYTHONPATH": str(tmp_path)}
    with (
        pytest.raises(AssertionError, match=said),
        NodeProcess([], environment, tmp_path / "log", module="bad") as node,
    ):
        node.wait()


@pytest.mark.parametrize(
    ("colour", "depth", "reliable"),
    [("raw", "16UC1", True), ("raw", "32FC1", False), ("jpeg", "png", True), ("png", "compressedDepth", False)],
)
def test_a_camera_arrives_as_it_was_sent(domain, colour, depth, reliable):
    pair = room_pair()
    with Peer(domain, "driver") as driver, Peer(domain, "listener") as listener:
        camera = Camera(driver, "target", pair, colour, depth, reliable)
        suffix, depth_suffix = camera.image.topic_name[13:], camera.depth.topic_name[13:]
        kinds = [CompressedImage if name else Image for name in (suffix, depth_suffix)]
        images = listener.collect(kinds[0], f"target/image{suffix}", reliable)
        depths = listener.collect(kinds[1], f"target/depth{depth_suffix}", reliable)
        driver.matched(camera.image, camera.depth)
        for _ in range(20):  # the listener may know of a best-effort driver only after the driver knows of it
            camera.publish(7_000_000_009)
            listener.spin(0.1)
            if images and depths:
                break
        (_, image), (_, metres) = images[0], depths[0]
        assert (image.header.stamp.sec, image.header.stamp.nanosec) == (7, 9)
        assert abs(rgb_image(image).astype(int) - pair.rgb1).mean() < (5 if colour == "jpeg" else 1e-9)
        assert abs(depth_image(metres) - pair.depth1)[pair.depth1 > 0].max() < 1e-3
