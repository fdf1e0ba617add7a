"""How far images seem to be displaced where a cause, which displaces nothing, is missing from the simulation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.diagnose.model.chain import Chain
from stages.diagnose.model.nominal import lit_mask
from stages.diagnose.model.parallel import per_site
from stages.effects.filters import gradients


def mimicked_shift(chains: Sequence[Chain], without: Sequence[Chain]) -> float:
    """rms over images of the shift, px, that explains most of what the causes change, beside a gain and an offset.

    chains, without : of every site, with the causes and without them
    """

    def of_site(k: int) -> Tensor:
        plain, use = without[k].render().double(), lit_mask(chains[k]).double()
        change = (chains[k].render() - plain) * use
        columns = torch.stack([*gradients(plain), plain, torch.ones_like(plain)], -1) * use[..., None]
        gram = torch.einsum("nhwa,nhwb->nab", columns, columns)
        score = torch.einsum("nhwa,nhw->na", columns, change)
        return (torch.linalg.pinv(gram, hermitian=True) @ score[..., None])[:, :2, 0]

    shifts = torch.cat(per_site(of_site, range(len(chains))))
    return float(shifts.square().sum(1).mean().sqrt())


__all__ = ["mimicked_shift"]
