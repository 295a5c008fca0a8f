"""Demonstrators that follow a rule, and the mistakes that make them imperfect.

They see what the learner sees, or, for the arm, its joint angles; never the state of a cloth.
"""

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.masks import cloth_mask, red_mask
from actors.envs.handkerchief import (
    DROP_POINTS_M,
    PICK_RULES,
    SUCCESS_PORTION,
    PickRule,
)
from actors.envs.planar_arm import (
    INCREMENTS_RAD,
    apply_action,
    end_effector_m,
    reaching_reward,
)

ROLL_TOWARDS = 3  # the drop point at the picture's bottom left, and away from its opposite one
PULL_BEYOND_PORTION = 1 / 6  # of the picture's width: the cloth is then half off the middle


def scripted_reach_action(joint_angles_rad: NDArray[np.float64]) -> int:
    """The action after which the reward of reaching is highest; of equals the first.

    Args:
        joint_angles_rad: f64[n], as in the environment's `info`.
    """
    n_actions = len(joint_angles_rad) * len(INCREMENTS_RAD)
    after_rad = np.stack([apply_action(joint_angles_rad, action) for action in range(n_actions)])
    # Rounded, so that the last bit of a sine does not choose between two joints.
    return int(reaching_reward(end_effector_m(after_rad)).round(9).argmax())


def scripted_flip_action(
    picture: NDArray[np.uint8], pick_rule: PickRule, camera: Camera, flat_px: int
) -> int:
    """The next action of a rule that flips a handkerchief by rolling it over and pulling it out.

    The rule takes the cloth's upper right end. It carries this end over the cloth to the bottom
    left drop point, which turns the cloth over bit by bit; where the cloth has gone too far to
    that side, it pulls the end to the upper right drop point, which brings the cloth back and
    spreads it. When enough is red, it picks the point that lies nearest to a drop point, which
    disturbs the cloth least.

    Args:
        picture: u8[H, H, 3], an observation.
        pick_rule: the environment's.
        camera: that took the picture.
        flat_px: pixels that the flat cloth would cover.

    Returns:
        Pick point * 6 + drop point.

    Raises:
        NoClothInViewError: the picture shows no cloth.
        ValueError: it is not a picture in colour.
    """
    find_pick_points, _ = PICK_RULES[pick_rule]
    picks_px = find_pick_points(picture).astype(np.float64) + 0.5
    if red_mask(picture).sum() >= SUCCESS_PORTION * flat_px:
        return _shortest_carry(picks_px, _drop_points_px(camera))
    return _roll_or_pull(picks_px, cloth_mask(picture), camera)


def imperfect_action(
    action: int, n_actions: int, mistake_rate: float, random: np.random.Generator
) -> int:
    """The action, or with a probability one of all actions at random.

    Raises:
        ValueError: the rate is not a probability.
    """
    if not 0.0 <= mistake_rate <= 1.0:
        raise ValueError(
            f"mistake_rate: expected a probability from 0 to 1; got {mistake_rate}; "
            "0 gives the demonstrator unchanged"
        )
    # Both are drawn always, so that one mistake more or less does not change the later ones.
    mistaken = random.random() < mistake_rate
    anything = int(random.integers(n_actions))
    return anything if mistaken else action


def _drop_points_px(camera: Camera) -> NDArray[np.float64]:
    drops_in_world = np.array([(x_m, y_m, 0.0) for x_m, y_m in DROP_POINTS_M])
    return camera.project_px(drops_in_world)


def _shortest_carry(picks_px: NDArray[np.float64], drops_px: NDArray[np.float64]) -> int:
    carry_px = np.linalg.norm(picks_px[:, None] - drops_px[None], axis=2)
    return int(carry_px.argmin())  # row by row: pick point * 6 + drop point


def _roll_or_pull(picks_px: NDArray[np.float64], mask: NDArray[np.bool_], camera: Camera) -> int:
    """Carry the rear end over the cloth, or back where the cloth has gone too far."""
    middle_px = camera.size_px / 2
    forward = _drop_points_px(camera)[ROLL_TOWARDS] - middle_px
    forward /= np.linalg.norm(forward)
    rows, columns = np.nonzero(mask)
    centroid_px = np.array([columns.mean(), rows.mean()]) + 0.5
    advance_px = (centroid_px - middle_px) @ forward
    pull = advance_px > PULL_BEYOND_PORTION * camera.size_px
    rear_end = (picks_px @ forward).argmin()
    drop = len(DROP_POINTS_M) - 1 - ROLL_TOWARDS if pull else ROLL_TOWARDS
    return int(rear_end) * len(DROP_POINTS_M) + drop
