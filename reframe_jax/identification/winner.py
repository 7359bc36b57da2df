"""Choose the entry of the table to report for a window, by probability or by thresholds."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import ORIENTATION_BODIES, PARALLEL_COSINE, SQUARE_COSINE
from reframe_jax.identification.naming import CLASS_CODES, NAME_OF_ENTRY, SAME_IN_ALL_TYPES
from reframe_jax.identification.optima import Types
from reframe_jax.model.fit import Data, Parameters, settle
from reframe_jax.model.solve import Compared, Searched
from reframe_jax.model.table import ENTRIES, Table, entries_at

Array = jax.Array
_VARIANT = 1e-3  # smallest probability of a reported entry, as a fraction of the probability of its name
_BEHIND = 1e9  # log probability that is subtracted from entries below this limit, which rank last
KIND_OF_ENTRY = np.array([entry.kind for entry in ENTRIES], np.int32)


class Winner(NamedTuple):
    """The reported entry of the table for a window."""

    code: Array  # () code of the entry, or ``NO_ENTRY``
    entry: Table  # its row of the table, or any row
    kind: Array  # () ``LinearType`` of the frame
    name_probability: Array  # () probability of its name; NaN with thresholds
    parameters: Parameters  # fitted parameters of the entry, differentiable with respect to the moments
    probability: Array  # (E,) probability of every entry


def winner_of_window(searched: Searched, compared: Compared, data: Data) -> Winner:
    """Find the most probable name of one window, its most probable entry, and the fit of this entry.

    The result is differentiable with respect to the moments in ``data``.
    """
    probability = jnp.exp(compared.log_probability)
    names = jax.ops.segment_sum(probability, jnp.asarray(NAME_OF_ENTRY), int(NAME_OF_ENTRY.max()) + 1)
    fitted = jnp.any(jnp.arange(len(probability))[:, None] == compared.chosen, axis=1)
    of_name = jnp.where(fitted, names[NAME_OF_ENTRY], -1)
    mine = fitted & (of_name >= jnp.max(of_name))
    # if all types express a constraint, its entries differ only in their errors: the type with the lowest
    # norm has the smallest error
    alike = jnp.any(mine & jnp.asarray(SAME_IN_ALL_TYPES)) & (probability > _VARIANT * jnp.max(of_name))
    rank = jnp.where(alike, -searched.norm[jnp.asarray(KIND_OF_ENTRY)], jnp.log(probability) - _BEHIND)
    code = jnp.argmax(jnp.where(mine, rank, -jnp.inf)).astype(jnp.int32)
    slot = jnp.argmax(compared.chosen == code).astype(jnp.int32)
    fitted = jax.tree.map(lambda leaf: leaf[slot], compared.parameters)
    entry = entries_at(code)
    parameters = settle(fitted, data, entry, searched.tilt_scale, entry.tied)
    return Winner(code, entry, jnp.asarray(KIND_OF_ENTRY)[code], jnp.max(of_name), parameters, probability)


def winner_by_thresholds(types: Types, searched: Searched, angular: Array, linear: Array) -> Winner:
    """Choose by the paper's rule: the types with the lowest norms, and their degrees of freedom.

    ``angular`` (2, 3) and ``linear`` (4, 3) are the degrees of freedom of all types, by thresholds of RMS
    velocities. Only the start parameters and the origins of ``searched`` are used.
    """
    a, linear_type = (jnp.argmin(norm).astype(jnp.int32) for norm in (types.angular_norm, types.linear_norm))
    r, t = jnp.sum(angular[a]), jnp.sum(linear[linear_type])
    # angle between the single free or held axes, in the body in which the linear frame is fixed
    turn = types.angular_axes[jnp.asarray(ORIENTATION_BODIES)[linear_type]]
    first = jnp.where(r == 1, turn[:, 2], turn[:, 0])
    second = jnp.where(t == 1, types.linear_axes[linear_type][:, 2], types.linear_axes[linear_type][:, 0])
    cosine = jnp.abs(first @ second)
    relation = jnp.where(cosine > PARALLEL_COSINE, 0, jnp.where(cosine < SQUARE_COSINE, 1, 2))
    code = jnp.asarray(CLASS_CODES)[linear_type, r, t, relation]
    parameters = jax.tree.map(lambda leaf: leaf[jnp.maximum(code, 0)], searched.starts)
    parameters = parameters._replace(origin=searched.origins[linear_type])
    unknown = jnp.full(len(ENTRIES), jnp.nan, types.linear_norm.dtype)
    entry = entries_at(jnp.maximum(code, 0))
    return Winner(code, entry, linear_type, unknown[0], parameters, unknown)
