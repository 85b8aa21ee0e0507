# SPDX-License-Identifier: Apache-2.0
"""The live node: topics in, newest pair to the worker, poses and diagnostics out. One thread besides the worker's.

Everything of ROS happens in the executor's thread, also publishing: so a reset that has been answered is never
followed by the result of a computation that was under way (images that were still on their way may follow), and nothing
is published while the node is taken down.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from garps_core.errors import GarpsError
from garps_ros.cameras import Frame
from garps_ros.estimates.outcomes import Origin, Outcome
from garps_ros.estimates.preparation import needs_depth
from garps_ros.live.estimator import Job, Result, Solver
from garps_ros.live.health import Health, memory
from garps_ros.live.inputs import Takers, camera_topics, subscribe
from garps_ros.live.intake import Intake
from garps_ros.live.log import Log
from garps_ros.live.node_parameters import NodeParameters
from garps_ros.live.priors import Priors
from garps_ros.live.publishing import Publishing
from garps_ros.live.remarks import note_outcome, note_result
from garps_ros.live.worker import Worker
from msg_adapters import NANOSECONDS, MessageError

OFTEN_S = 0.2
STALE = "stale: reset or settings changed"
BACKWARDS = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1), on_clock_change=False)


class PoseNode:
    """Subscribes to one or two cameras and publishes the pose of the source camera in the target camera.

    It is ready once its worker has loaded and compiled what the first pair needs.

    Args:
        node: the rclpy node that it gives its interfaces to.

    Raises:
        ConfigError: a parameter given at the start is wrong.
    """

    def __init__(self, node: Node) -> None:
        self.refusal = ""
        """Why it cannot become ready; whoever runs it then ends it."""
        self._node, self._log, self._is_ready = node, Log(node.get_logger()), False
        self._health, self._priors = Health(), Priors()
        self._enabled, self._epoch, self._generation = True, 0, 0
        self._parameters = NodeParameters(node, self._settings_changed)
        self._decisive = self._what_decides()
        self._publishing = Publishing(node, self._parameters.node.publish_tf, self._log)
        depth = needs_depth(self._parameters.config)
        cameras = camera_topics(node, self._parameters.node, depth)
        self._intake = Intake(cameras, self._slop_ns, self._refused, self._forget)
        takers = Takers(self._image, self._info, self._prior, self._log.warn)
        self._inputs = subscribe(node, self._parameters.node, depth, takers)
        self._news = node.create_guard_condition(self._deliver)
        self._solver = Solver(self._log.info)
        self._worker: Worker[Job, Result] = Worker(self._solver, self._news.trigger, self._prepare)
        self._apply_settings()
        node.create_service(Trigger, "~/reset", self._reset)
        node.create_service(SetBool, "~/enable", self._enable)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # the node's own clock may stand still, or jump
        node.create_timer(OFTEN_S, self._often, clock=steady)
        node.create_timer(1.0, self._every_second, clock=steady)
        # The handle is kept: without it rclpy calls into freed memory when the clock jumps.
        self._jump_handle = node.get_clock().create_jump_callback(BACKWARDS, post_callback=self._clock_jumped)

    def stop(self, timeout_s: float) -> bool:
        """End the worker; False when its computation outlasts the timeout."""
        return self._worker.stop(timeout_s)

    def failed(self, error: Exception, trace: str) -> None:
        """Note an error that nobody expected in a callback; the node goes on."""
        self._health.fail("callback", f"{type(error).__name__}: {error}")
        self._log.error("callback", f"unexpected error, going on: {trace}")

    # --- what comes in ----------------------------------------------------------------------------------------------

    def _image(self, index: int, role: int, message: Any) -> None:
        for frames in self._intake.add(index, role, message):
            self._offer(frames)

    def _info(self, index: int, message: Any) -> None:
        for frames in self._intake.add_info(index, message):
            self._offer(frames)

    def _prior(self, message: Any) -> None:
        if self._parameters.node.pairing == "keyframe":
            self._refused("prior", "a prior is not used with pairing:=keyframe")
            return
        try:
            self._priors.add(message)
        except MessageError as error:
            self._refused("prior", str(error))

    def _offer(self, frames: tuple[Frame, ...]) -> None:
        """Give frames that are complete to the worker, in place of older ones that it has not begun."""
        self._health.pairs_in += 1
        self._health.last_pair_s = time.monotonic()
        idle = self._idle()
        if idle:
            self._health.dropped[idle] += 1
            return
        settings = self._parameters.node
        prior = self._priors.near(frames[0].stamp_ns, round(settings.prior_max_age * NANOSECONDS))
        job = Job(
            frames,
            settings,
            self._parameters.config,
            self._epoch,
            self._generation,
            time.monotonic(),
            prior,
            self._publishing.clouds_wanted,
        )
        if self._worker.offer(job):
            self._health.dropped["a newer pair came"] += 1

    def _idle(self) -> str:
        """Why nothing is to be computed; "" when it is."""
        if not self._enabled:
            return "disabled by ~/enable"
        lazy = self._parameters.node.lazy and self._parameters.node.pairing == "cameras"
        return "nobody subscribes (lazy)" if lazy and not self._publishing.wanted else ""

    # --- what goes out ----------------------------------------------------------------------------------------------

    def _deliver(self) -> None:
        """Publish what the worker has finished."""
        if self._worker.prepared and not self._is_ready:
            self._is_ready = True
            self._say_ready()
        for result in self._worker.take():
            if result.job.generation != self._generation:
                self._health.dropped[STALE] += 1
                continue
            note_result(result, self._health, self._log)
            self._publish(result)

    def _publish(self, result: Result) -> None:
        """The pose of a result, if any attempt has one; else why the last has none."""
        for origin in (o for o in result.outcomes if isinstance(o, Origin)):
            self._log.info(f"{origin.frame_id} begins at the image of {origin.stamp_ns} ns")
            self._health.facts["frames"] = f"{origin.child_frame_id} in {origin.frame_id}"
        attempts = [outcome for outcome in result.outcomes if isinstance(outcome, Outcome)]
        if not attempts:
            return
        outcome = next((attempt for attempt in attempts if attempt.T is not None), attempts[-1])
        note_outcome(outcome, self._health)
        if outcome.T is None or outcome.covariance is None:
            self._reject(outcome.row.status, outcome.row.reason)
            return
        try:
            self._health.facts["transform"] = self._publishing.publish(outcome, outcome.T, outcome.covariance)
        except MessageError as error:
            self._reject("not_publishable", str(error))
            return
        arrived_s = result.job.arrived_s
        self._health.publish(time.monotonic() - arrived_s, result.began_s - arrived_s, result.core_s)
        if result.clouds is not None:
            self._publishing.show(result.clouds, outcome)

    def _reject(self, status: str, reason: str) -> None:
        self._health.reject(status, reason)
        self._log.warn(f"reject {status}", f"no pose: {status}: {reason}")

    # --- what changes -----------------------------------------------------------------------------------------------

    @property
    def _slop_ns(self) -> int:
        return round(self._parameters.node.sync_slop * NANOSECONDS)

    def _settings_changed(self) -> None:
        """Results of other settings are dropped, where those had a say; a keyframe read otherwise is forgotten."""
        before, self._decisive = self._decisive, self._what_decides()
        if before[:3] != self._decisive[:3]:
            self._epoch += 1
        if before != self._decisive:
            self._generation += 1
            self._withdraw()
        self._apply_settings()

    def _what_decides(self) -> tuple[Any, ...]:
        """The settings that a result depends on; the first three are about reading images."""
        s = self._parameters.node
        config = self._parameters.config
        return s.rectified, s.allow_resized, config.reconstruction, s.source_frame, s.target_frame, config

    def _apply_settings(self) -> None:
        self._intake.slop_ns = self._slop_ns
        rate = self._parameters.node.max_rate
        self._worker.min_period_s = 1.0 / rate if rate > 0 else 0.0

    def _clock_jumped(self, jump: Any) -> None:
        self._intake.forget()
        self._forget(f"the clock went back by {-jump.delta.nanoseconds * 1e-9:.3f} s")

    def _forget(self, why: str) -> None:
        """Begin anew: keyframe, waiting frames and results of before are dropped."""
        self._epoch += 1
        self._generation += 1
        self._priors.forget()
        self._health.facts.clear()
        self._health.restarts, self._health.last_restart = self._health.restarts + 1, why
        self._withdraw()
        self._log.warn("forget", f"{why}: beginning anew")

    def _withdraw(self) -> None:
        if self._worker.withdraw():
            self._health.dropped[STALE] += 1

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._intake.forget()
        self._priors.forget(standing=True)
        self._forget("reset")
        response.success, response.message = True, "began anew: keyframe, prior and waiting images are forgotten"
        return response

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._enabled = bool(request.data)
        if not self._enabled:
            self._generation += 1
            self._withdraw()
        response.success, response.message = True, "enabled" if self._enabled else "disabled: nothing is published"
        return response

    # --- how it is doing --------------------------------------------------------------------------------------------

    def _often(self) -> None:
        for input_ in self._inputs:
            input_.follow_offers()
        for frames in self._intake.settle():
            self._offer(frames)

    def _every_second(self) -> None:
        self._revive()
        now_s, settings, idle = time.monotonic(), self._parameters.node, self._idle()
        findings = [
            self._health.inputs(
                [i.state() for i in self._inputs], now_s, settings.input_timeout, self._clock_trouble()
            ),
            self._health.estimates(
                idle, self._worker.busy_s, self._intake.gaps_s(), settings.sync_slop, now_s, settings.input_timeout
            ),
            self._health.machine(self._solver.stage, self._worker.busy_s, settings.stage_timeout, self._machine()),
        ]
        self._publishing.report(findings)
        for finding in findings:
            if finding.level:
                self._log.warn(f"finding {finding.name}", f"{finding.name}: {finding.message}")

    def _revive(self) -> None:
        if not self._worker.death or self.refusal:
            return
        if isinstance(self._worker.error, GarpsError):  # none leaves a job: it is of what was to be loaded
            self.refusal = str(self._worker.error)
            return
        self._health.fail("worker", f"ended by {self._worker.death}; restarted")
        self._log.error("worker", f"worker ended by {self._worker.death}: restarted")
        self._epoch += 1
        self._generation += 1
        self._withdraw()
        self._worker.restart()

    def _clock_trouble(self) -> str:
        simulated = self._node.get_parameter("use_sim_time").value and self._node.get_clock().now().nanoseconds == 0
        return "use_sim_time is true and nothing has come on /clock yet" if simulated else ""

    def _machine(self) -> dict[str, str]:
        return memory(self._parameters.config.device) | {
            "enabled": str(self._enabled),
            "unpaired messages": str(self._intake.unpaired),
            "scale from": self._solver.scale,
        }

    def _prepare(self) -> None:
        self._solver.prepare(self._parameters.config)

    # --- what it says -----------------------------------------------------------------------------------------------

    def _refused(self, topic: str, reason: str) -> None:
        self._health.refuse(topic, reason)
        self._log.warn(f"refused {topic}", f"{topic}: {reason}")

    def _say_ready(self) -> None:
        topics = ", ".join(f"{i.state().role} <- {i.topic}" for i in self._inputs)
        pose = self._node.resolve_topic_name("~/pose")
        self._log.info(f"ready: {self._parameters.node.pairing}, {topics}; publishes {pose}")
