# SPDX-License-Identifier: Apache-2.0
"""The live node. This is the path of an image from its topic to the published pose.

In the executor's thread:
1. `subscriptions.Input._arrived` counts the arrival and hands the message on.
2. `node.PoseNode._image` gives it to the intake, and offers the frames that became complete.
3. `intake.Intake.add` begins anew if time jumped back.
4. `garps_ros.frames.assembly.Assembly.add` joins image, depth and calibration of one camera to a frame, and the frames
   of two cameras to a pair.
5. `node.PoseNode._offer` adds settings and prior and makes a job.
6. `worker.Worker.offer` keeps the newest job only.

In the worker's thread:
7. `jobs.JobRunner.__call__` computes the job.
8. `garps_ros.estimates.outcomes.estimate_pair` takes two cameras, `follow_frame` beside it one camera and its keyframe.
9. `garps_ros.frames.frame.view_from_messages` decodes, chooses the calibration and undistorts.
10. `jobs.JobRunner._estimate` calls the core.

In the executor's thread again:
11. `node.PoseNode._deliver` drops stale results.
12. `publishers.Publishers.publish` sends pose, odometry and transform.

Beside the path: `inputs` subscribes, `node_parameters` holds the settings, `priors` the given poses, `counts` counts,
and `diagnostics` makes the lines of /diagnostics, each in one place.
"""
