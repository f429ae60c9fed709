import numpy as np
import pytest

from lerobot_policy_symview.symmetry.groups import GROUP_NAMES, block_diagonal, make_group


@pytest.mark.parametrize("name", GROUP_NAMES)
def test_products_and_inverses_match_the_representations(name):
    group = make_group(name)
    assert group.size == (2 if name[0] == "D" else 1) * int(name[1])
    for frequency in (1, 2):
        matrices = group.rotation(frequency)
        for g in range(group.size):
            for h in range(group.size):
                np.testing.assert_allclose(matrices[g] @ matrices[h], matrices[group.product[g, h]], atol=1e-11)
                assert group.determinants[g] * group.determinants[h] == group.determinants[group.product[g, h]]
    assert (group.product[np.arange(group.size), group.inverse] == 0).all()
    assert (group.product[np.arange(group.size)[:, None], group.quotient] == np.arange(group.size)).all()


def test_elements_reflect_before_they_rotate():
    matrices = make_group("D4").rotation()
    np.testing.assert_array_equal(matrices[1], [[0, -1], [1, 0]])
    np.testing.assert_array_equal(matrices[4], [[1, 0], [0, -1]])
    np.testing.assert_array_equal(matrices[5], matrices[1] @ matrices[4])


def test_direct_sum_puts_blocks_on_the_diagonal():
    group = make_group("D4")
    joined = block_diagonal([np.ones((8, 1, 1)), group.rotation()])
    np.testing.assert_array_equal(joined[5], [[1, 0, 0], [0, 0, 1], [0, 1, 0]])


def test_unknown_group_error_names_the_flag():
    with pytest.raises(ValueError, match=r"--policy.group 'D6', expected one of: D4"):
        make_group("D6")
