"""From a plan to the program's object, the same way on every host."""

from caneflow.messages.rig import read_rig
from caneflow.runtime.dataflow.programs import validated_settings
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.program import Context, Operator, Program, Sink, Source
from caneflow.runtime.stages.seeds import generator


def build(program: Program, plan: NodePlan) -> Operator | Source | Sink:
    """The program's object with its settings, rig and random numbers, as every host makes it."""
    settings = validated_settings(program, plan.settings)
    ports = plan.outputs if issubclass(program, Source) else plan.inputs
    kinds = {port: wire.kind for port, wire in ports.items()}
    random = generator(plan.seed, plan.node)
    keys = {port: wire.key for port, wire in ports.items()}
    rig = read_rig(plan.rig)
    context = Context(
        node=plan.node,
        rig=rig,
        ports=kinds,
        random=random,
        keys=keys,
        replay=plan.replay,
        takes_over=plan.takes_over,
    )
    return program(settings, context)
