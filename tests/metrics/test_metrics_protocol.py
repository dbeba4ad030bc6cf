"""Which protocol is the headline, and what it is called."""

from vlgs.metrics.protocol import EvaluationProtocol


def test_auto_takes_what_the_labels_allow():
    auto = EvaluationProtocol()
    assert auto.resolve(has_dense_labels=True) == "dense"
    assert auto.resolve(has_dense_labels=False) == "lerf_ovs"
    assert EvaluationProtocol("lerf_ovs").resolve(has_dense_labels=True) == "lerf_ovs"


def test_tags_carry_name_form_and_version():
    assert EvaluationProtocol(strict=True).tag("lerf_ovs") == "lerf_ovs-strict@1"
    assert EvaluationProtocol().tag("lerf_ovs") == "lerf_ovs@1"
    assert EvaluationProtocol(strict=True).tag("dense") == "dense@1"
