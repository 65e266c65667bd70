"""Names and sides of the model's actions."""

import numpy as np

from shared.actions.names import ARKIT_NAMES, BOTH_SIDES, arkit_name, lacking_names, named_actions


def test_arkit_has_52_names():
    assert len(ARKIT_NAMES) == len(set(ARKIT_NAMES)) == 52
    assert arkit_name("mouth_roll_lower") == "mouthRollLower" and arkit_name("eye_blink_left") == "eyeBlinkLeft"


def test_every_action_of_the_model_has_a_name_of_arkit(model):
    names = tuple(named_actions(model))
    assert len(names) == 29 and set(names) <= set(ARKIT_NAMES)
    assert list(names) == [name for name in ARKIT_NAMES if name in names]
    assert len(lacking_names(names)) == 23 and lacking_names(ARKIT_NAMES) == []


def test_both_sides_add_up_to_the_action_of_the_model(model):
    actions = named_actions(model)
    for name in BOTH_SIDES:
        left, right = (actions[arkit_name(f"{name}_{side}")] for side in ("left", "right"))
        whole = model.expression_basis[model.expression_names.index(name)]
        np.testing.assert_allclose(left + right, whole, atol=1e-6)
        assert np.abs(left[model.template[:, 0] < -10.0]).max() == 0.0
        assert np.abs(right[model.template[:, 0] > 10.0]).max() == 0.0


def test_left_is_the_heads_own_left(model):
    """+x; of the jaw where it moves to, and the other way as the mirror image."""
    actions = named_actions(model)
    for name, moves in actions.items():
        if name.endswith(("Left", "Right")) and not name.startswith("jaw"):
            moved = np.linalg.norm(moves, axis=1)
            assert ((moved @ model.template[:, 0]) > 0.0) == name.endswith("Left"), name
    left, right = actions["jawLeft"], actions["jawRight"]
    chin = np.argmax(np.abs(left[:, 0]))
    assert left[chin, 0] > 5.0 and right[:, 0].min() < -5.0
    np.testing.assert_allclose(np.sort(left[:, 0]), np.sort(-right[:, 0]), atol=1e-6)
