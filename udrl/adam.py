"""Adam that starts without torch's compiler."""

from inspect import unwrap

import torch


class Adam(torch.optim.Adam):
    """``torch.optim.Adam`` without its decorators, which import torch's compiler on first use.

    That import would take 2 s and 70 MB in every learner, and nothing here is compiled. Results
    are the same. If a future torch is decorated otherwise, only the time is lost.
    """

    add_param_group = unwrap(torch.optim.Adam.add_param_group)
    step = torch.no_grad()(unwrap(torch.optim.Adam.step))
