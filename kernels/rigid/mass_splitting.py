"""Masses split among contacts, for bodies with many contacts that push the same way.

XPBD relaxes all contacts at once and adds up their corrections. Those on a ball point in different directions, but the
corners of boxes face to face all close the same gap: n of them overshoot it 0.35 n times (0.35 is the relaxation), and
from some ten on iterations diverge. A contact that acts on its share of each body's mass closes its share of the gap
(Tonge, Benevolenski and Voroshilov 2012, "Mass Splitting for Jitter-Free Parallel Rigid Body Simulation"). Its impulses
on both bodies stay opposite, so that momentum is kept, which dividing each body's sum by its number of contacts would
not do.
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import ContactView, contact_bodies, contact_count, contact_depth

wp.set_module_options({"enable_backward": False})

_UNSPLIT = 4
"""Contacts that share a body without splitting it."""
_TOUCHING_GAP = 0.1
"""Distance up to which contacts count, over the sum of their shapes' contact gaps."""


@wp.kernel
def _count_contacts(
    contacts: ContactView,
    body_q_in: wp.array[wp.transform],
    splits_in: wp.array[wp.int32],
    counts_out: wp.array[float],
):
    i = wp.tid()
    if i >= contact_count(contacts):
        return
    gaps = contacts.shape_gap[contacts.shape0[i]] + contacts.shape_gap[contacts.shape1[i]]
    if contact_depth(contacts, body_q_in, i) < -_TOUCHING_GAP * gaps:
        return
    body0, body1 = contact_bodies(contacts, i)
    if body0 >= 0 and splits_in[body0] == 1:
        wp.atomic_add(counts_out, body0, 1.0)
    if body1 >= 0 and splits_in[body1] == 1:
        wp.atomic_add(counts_out, body1, 1.0)


@wp.kernel
def _find_shares(counts_io: wp.array[float], shares_out: wp.array[float]):
    body = wp.tid()
    shares_out[body] = wp.max(1.0, counts_io[body] / float(_UNSPLIT))
    counts_io[body] = 0.0


def launch_count_shares(contacts: ContactView, body_q, splits, counts, shares):
    """Write into how many shares each body is split.

    Args:
        contacts: The contacts.
        body_q: Poses that they were found at, shape [body_count].
        splits: 1 for bodies whose mass may be split, shape [body_count].
        counts: Zeros, which they are again afterwards, shape [body_count].
        shares: Out, number of shares, a quarter of the contacts that touch or nearly do, 1 at least, shape
            [body_count].
    """
    inputs = [contacts, body_q, splits]  # whole numbers: in any order they add up to the same
    wp.launch(_count_contacts, dim=contacts.shape0.shape[0], inputs=inputs, outputs=[counts], device=shares.device)
    wp.launch(_find_shares, dim=len(shares), outputs=[counts, shares], device=shares.device)


@wp.kernel
def _split_masses(
    # inputs:
    shares_in: wp.array[float],
    inv_mass_in: wp.array[float],
    inv_inertia_in: wp.array[wp.mat33],
    # outputs:
    inv_mass_out: wp.array[float],
    inv_inertia_out: wp.array[wp.mat33],
):
    body = wp.tid()
    inv_mass_out[body] = shares_in[body] * inv_mass_in[body]
    inv_inertia_out[body] = shares_in[body] * inv_inertia_in[body]


def launch_split_masses(shares, whole, split):
    """Write the inverse masses [1/kg] and inertias [1/(kg·m²)] of the share of each body that one contact acts on.

    Args:
        shares: Number of shares of each body, shape [body_count].
        whole: Inverse masses and inertias of the bodies, each of shape [body_count].
        split: Out, those of a share, each of shape [body_count].
    """
    wp.launch(_split_masses, dim=len(shares), inputs=[shares, *whole], outputs=[*split], device=shares.device)
