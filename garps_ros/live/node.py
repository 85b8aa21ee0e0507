# SPDX-License-Identifier: Apache-2.0
"""The live node: topics in, newest pair to the worker, poses and diagnostics out. `garps_ros.live` lists the path.

Everything of ROS happens in the executor's thread, also publishing. Therefore the result of a computation that was
under way never follows the answer to a reset (images that were still on their way may), and nothing is published while
the node is taken down. The only other thread is the worker's.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from garps_core.errors import GarpsError
from garps_ros.estimates.outcomes import Origin
from garps_ros.estimates.preparation import needs_depth
from garps_ros.frames.frame import Frame
from garps_ros.live.counts import Counts
from garps_ros.live.diagnostics import Diagnostics, NodeState
from garps_ros.live.inputs import Takers, camera_topics, subscribe
from garps_ros.live.intake import Intake
from garps_ros.live.jobs import Job, JobRunner, Result, decisive_settings
from garps_ros.live.log import Log
from garps_ros.live.node_parameters import NodeParameters
from garps_ros.live.priors import Priors
from garps_ros.live.publishers import Publishers
from garps_ros.live.worker import Worker
from msg_adapters import NANOSECONDS, MessageError

OFTEN_S = 0.2
"""Period at which publishers are checked and waiting frames are released, s."""
STALE = "stale: reset or settings changed"
BACKWARDS = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1), on_clock_change=False)


class PoseNode:
    """Subscribes to one or two cameras and publishes the pose of the source camera in the target camera.

    It is ready once its worker has loaded and compiled everything that the first pair needs.

    Args:
        node: the rclpy node that it gives its interfaces to.

    Raises:
        ConfigError: a parameter given at the start is wrong.
    """

    def __init__(self, node: Node) -> None:
        self.start_error = ""
        """Error because of which the node cannot become ready and the process must end; "" = none."""
        self._node, self._log, self._is_ready = node, Log(node.get_logger()), False
        self._counts, self._priors = Counts(), Priors()
        self._diagnostics = Diagnostics(self._counts)
        self._enabled, self._epoch, self._generation = True, 0, 0
        self._parameters = NodeParameters(node, self._settings_changed)
        self._decisive = decisive_settings(self._parameters.node, self._parameters.config)
        self._publishers = Publishers(node, self._parameters.node.publish_tf, self._log)
        depth = needs_depth(self._parameters.config)
        cameras = camera_topics(node, self._parameters.node, depth)
        self._intake = Intake(cameras, self._slop_ns, self._refuse, self._forget)
        takers = Takers(self._image, self._info, self._prior, self._log.warn)
        self._inputs = subscribe(node, self._parameters.node, depth, takers)
        self._result_ready = node.create_guard_condition(self._deliver)
        self._runner = JobRunner(self._log.info)
        self._worker: Worker[Job, Result] = Worker(self._runner, self._result_ready.trigger, self._prepare)
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
        """Count and log an unexpected error of a callback; the node goes on."""
        self._counts.fail("callback", f"{type(error).__name__}: {error}")
        self._log.error("callback", f"unexpected error, going on: {trace}")

    # --- messages in ------------------------------------------------------------------------------------------------

    def _image(self, index: int, role: int, message: Any) -> None:
        for frames in self._intake.add(index, role, message):
            self._offer(frames)

    def _info(self, index: int, message: Any) -> None:
        for frames in self._intake.add_info(index, message):
            self._offer(frames)

    def _prior(self, message: Any) -> None:
        if self._parameters.node.pairing == "keyframe":
            self._refuse("prior", "a prior is not used with pairing:=keyframe")
            return
        try:
            self._priors.add(message)
        except MessageError as error:
            self._refuse("prior", str(error))

    def _refuse(self, topic: str, reason: str) -> None:
        self._counts.refuse(topic, reason)
        self._log.warn(f"refused {topic}", f"message refused: {topic}: {reason}")

    def _offer(self, frames: tuple[Frame, ...]) -> None:
        """Give frames that are complete to the worker, in place of older ones that it has not begun."""
        self._counts.pairs_in += 1
        self._counts.last_pair_s = time.monotonic()
        idle = self._idle()
        if idle:
            self._counts.dropped[idle] += 1
            return
        settings = self._parameters.node
        job = Job(
            frames,
            settings,
            self._parameters.config,
            self._epoch,
            self._generation,
            arrived_s=time.monotonic(),
            prior=self._priors.near(frames[0].stamp_ns, round(settings.prior_max_age * NANOSECONDS)),
            clouds=self._publishers.clouds_wanted,
        )
        if self._worker.offer(job):
            self._counts.dropped["a newer pair came"] += 1

    def _idle(self) -> str:
        """Return why nothing is to be computed; "" when something is."""
        if not self._enabled:
            return "disabled by ~/enable"
        lazy = self._parameters.node.lazy and self._parameters.node.pairing == "cameras"
        return "nobody subscribes (lazy)" if lazy and not self._publishers.wanted else ""

    # --- poses out --------------------------------------------------------------------------------------------------

    def _deliver(self) -> None:
        """Publish the results that the worker has finished."""
        if self._worker.prepared and not self._is_ready:
            self._is_ready = True
            self._say_ready()
        for result in self._worker.take():
            if result.job.generation != self._generation:
                self._counts.dropped[STALE] += 1
                continue
            self._diagnostics.note(result)
            self._log_warnings(result)
            self._publish(result)

    def _log_warnings(self, result: Result) -> None:
        for outcome in result.outcomes:
            if isinstance(outcome, Origin):
                self._log.info(f"{outcome.frame_id} begins at the image of {outcome.stamp_ns} ns")
        if result.prior not in ("none", "used"):
            self._log.warn("prior", f"prior {result.prior}")
        for warning in result.warnings:
            self._log.warn(f"warning {warning}", warning)
        if result.trace:
            self._log.error("estimate", f"unexpected error: {result.trace}")

    def _publish(self, result: Result) -> None:
        """Publish the pose of a result if any attempt has one; otherwise count the last attempt as rejected."""
        attempt = result.attempt
        if attempt is None:
            return
        if attempt.T is None or attempt.covariance is None:
            self._reject(attempt.row.status, attempt.row.reason)
            return
        try:
            self._publishers.publish(attempt, attempt.T, attempt.covariance)
        except MessageError as error:
            self._reject("not_publishable", str(error))
            return
        arrived_s = result.job.arrived_s
        self._counts.publish(time.monotonic() - arrived_s, result.began_s - arrived_s, result.core_s)
        if result.clouds is not None:
            self._publishers.publish_clouds(result.clouds, attempt)

    def _reject(self, status: str, reason: str) -> None:
        self._counts.reject(status, reason)
        self._log.warn(f"rejected {status}", f"pair rejected: {status}: {reason}")

    # --- changes ----------------------------------------------------------------------------------------------------

    @property
    def _slop_ns(self) -> int:
        return round(self._parameters.node.sync_slop * NANOSECONDS)

    def _settings_changed(self) -> None:
        """Drop results whose settings have changed; forget a keyframe that was read by other settings."""
        before, self._decisive = self._decisive, decisive_settings(self._parameters.node, self._parameters.config)
        if before[0] != self._decisive[0]:
            self._epoch += 1
        if before != self._decisive:
            self._drop_results()
        self._apply_settings()

    def _apply_settings(self) -> None:
        self._intake.slop_ns = self._slop_ns
        rate = self._parameters.node.max_rate
        self._worker.min_period_s = 1.0 / rate if rate > 0 else 0.0

    def _clock_jumped(self, jump: Any) -> None:
        self._intake.forget()
        self._forget(f"the clock went back by {-jump.delta.nanoseconds * 1e-9:.3f} s")

    def _forget(self, why: str) -> None:
        """Start anew: drop the keyframe, waiting frames and all earlier results."""
        self._epoch += 1
        self._priors.forget()
        self._diagnostics.forget()
        self._counts.restart(why)
        self._drop_results()
        self._log.warn("forget", f"{why}: starting anew")

    def _drop_results(self) -> None:
        """Drop the job that waits, and the result of the one that is being computed."""
        self._generation += 1
        if self._worker.withdraw():
            self._counts.dropped[STALE] += 1

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._intake.forget()
        self._priors.forget(standing=True)
        self._forget("reset")
        response.success, response.message = True, "began anew: keyframe, prior and waiting images are forgotten"
        return response

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._enabled = bool(request.data)
        if not self._enabled:
            self._drop_results()
        response.success, response.message = True, "enabled" if self._enabled else "disabled: nothing is published"
        return response

    # --- timers -----------------------------------------------------------------------------------------------------

    def _often(self) -> None:
        for input_ in self._inputs:
            input_.follow_offers()
        for frames in self._intake.settle():
            self._offer(frames)

    def _every_second(self) -> None:
        self._revive()
        checks = self._diagnostics.checks(self._state())
        self._publishers.publish_checks(checks)
        for check in checks:
            if check.level:
                self._log.warn(f"check {check.name}", f"{check.name}: {check.message}")

    def _state(self) -> NodeState:
        simulated = self._node.get_parameter("use_sim_time").value and self._node.get_clock().now().nanoseconds == 0
        return NodeState(
            settings=self._parameters.node,
            now_s=time.monotonic(),
            inputs=[input_.state() for input_ in self._inputs],
            clock_warning="use_sim_time is true and nothing has come on /clock yet" if simulated else "",
            idle=self._idle(),
            stage=self._runner.stage,
            busy_s=self._worker.busy_s,
            gaps_s=self._intake.gaps_s(),
            unpaired=self._intake.unpaired,
            enabled=self._enabled,
            device=self._parameters.config.device,
            scale=self._runner.scale,
            transform=self._publishers.transform,
        )

    def _revive(self) -> None:
        """Start a dead worker again; give up where networks could not be loaded."""
        if not self._worker.death or self.start_error:
            return
        if isinstance(self._worker.error, GarpsError):  # a job catches these, so this one came from loading
            self.start_error = str(self._worker.error)
            return
        self._counts.fail("worker", f"ended by {self._worker.death}; restarted")
        self._log.error("worker", f"worker ended by {self._worker.death}: restarted")
        self._epoch += 1
        self._drop_results()
        self._worker.restart()

    def _prepare(self) -> None:
        self._runner.prepare(self._parameters.config)

    def _say_ready(self) -> None:
        topics = ", ".join(f"{i.state().role} <- {i.topic}" for i in self._inputs)
        pose = self._node.resolve_topic_name("~/pose")
        self._log.info(f"ready: {self._parameters.node.pairing}, {topics}; publishes {pose}")
