from deploy.dpu.board import load_dpu
from deploy.dpu.checker.operators import judge
from deploy.dpu.checker.traditional import judge_traditional, verdict
from model.traditional.compensate import RADIUS_PX

DPU = load_dpu("vck190")
STEPS = judge_traditional(DPU)


def test_what_defines_the_chain_is_refused_by_the_rules() -> None:
    refused = {step.op.op_type for step in STEPS if step.broken}
    assert refused >= {"DFT", "TopK", "Gather", "Cholesky", "Pad"}
    assert all(step.broken == judge(step.op, DPU, quantised=False) for step in STEPS)
    assert all(broken.finding.remedy for step in STEPS for broken in step.broken)


def test_the_rules_allow_what_they_allow() -> None:
    assert {step.op.op_type for step in STEPS if not step.broken} == {"Mul", "Add", "AveragePool"}


def test_its_filter_is_too_large_for_a_convolution() -> None:
    (conv,) = (step for step in STEPS if step.op.op_type == "Conv")
    assert conv.op.window.kernel == (2 * RADIUS_PX + 1,) * 2
    assert [broken.rule for broken in conv.broken] == ["conv kernel", "conv weight bank", "conv window"]


def test_the_verdict_counts_the_rules() -> None:
    refused = sum(bool(step.broken) for step in STEPS)
    assert f"refuses {refused} of its {len(STEPS)} operators" in verdict(STEPS)
    allowed = [step for step in STEPS if not step.broken]
    assert f"refuses 0 of its {len(allowed)}" in verdict(allowed)
    assert f"more than {len(allowed)} in a row" in verdict(allowed)
