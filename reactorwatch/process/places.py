"""Places: parts of a process in which something unknown may act, and how it then enters the equations.

A correction g, a function of states and inputs, enters in one of five ways:

| kind | enters | unit of g |
|---|---|---|
| source | dx/dt + g, for one state | of the state a minute |
| factor | every listed term of the balances times (1 + g) | 1 |
| capacity | dx/dt / (1 + g), for one state | 1 |
| input | u + g, for one input or parameter | of the input |
| sensor | y + g | of the output |

A term that occurs in several balances, such as a reaction with its heat, is one place: a correction acts on all of
them. So a place is recognised by what it does to each balance. A process declares its places (`ProcessModel.places`);
for one that does not, they follow from its equations.
"""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.model import Place, ProcessModel

SOURCE, FACTOR, CAPACITY, INPUT, SENSOR = "source", "factor", "capacity", "input", "sensor"


def places_of(model: ProcessModel) -> tuple[Place, ...]:
    """Places of a model: the declared ones, or those that follow from its equations."""
    return model.places or _default_places(model)


def find_place(model: ProcessModel, name: str) -> Place:
    """Find a place by its name.

    Raises:
        ValueError: the model has no such place.
    """
    for place in places_of(model):
        if place.name == name:
            return place
    raise ValueError(f"{model.name} has no place {name!r} (it has {', '.join(item.name for item in places_of(model))})")


def correct(model: ProcessModel, place: Place, correction: ca.SX) -> ProcessModel:
    """Copy of a model with a correction in a place."""
    if place.kind == FACTOR:
        for state, term in place.flows.items():
            model = model.add_rate(state, correction * model.term(term))
        return model
    if place.kind == SOURCE:
        return model.add_rate(place.of, correction)
    if place.kind == CAPACITY:
        index = model.state_index(place.of)
        return replace(
            model, rhs=tuple(item / (1 + correction) if i == index else item for i, item in enumerate(model.rhs))
        )
    if place.kind == INPUT:
        symbols = {item.name: item.symbol for item in model.inputs}
        symbol = symbols[place.of] if place.of in symbols else model.parameter(place.of).symbol
        return model.substitute(symbol, symbol + correction)
    output = model.output(place.of)
    return model.with_output(replace(output, expression=output.expression + correction))


def unit_of(model: ProcessModel, place: Place) -> str:
    """Unit of a correction in a place."""
    if place.kind in (FACTOR, CAPACITY):
        return "1"
    unit = unit_of_variable(model, place.of)
    return f"{unit}/min" if place.kind == SOURCE else unit


def unit_of_variable(model: ProcessModel, name: str) -> str:
    """Unit of a state, input, output or parameter; 1 for a term."""
    units = {item.name: item.unit for item in model.parameters} | {item.name: item.unit for item in model.states}
    return (units | model.units).get(name, "1")


def variable_expression(model: ProcessModel, name: str) -> ca.SX:
    """Expression of a variable: a state, an input or a term."""
    for item in (*model.states, *model.inputs):
        if item.name == name:
            return item.symbol
    for output in model.outputs:
        if output.name == name:
            return output.expression
    return model.term(name)


def _default_places(model: ProcessModel) -> tuple[Place, ...]:
    """A source in each balance, an error of each input and of each sensor."""
    variables = (*model.states, *model.inputs)
    sources = tuple(
        Place(
            state.balance or state.name,
            state.balance or state.name,
            SOURCE,
            of=state.name,
            variables=tuple(item.name for item in variables if ca.depends_on(rate, item.symbol)) or (state.name,),
        )
        for state, rate in zip(model.states, model.rhs, strict=True)
        if state.name not in model.at_rest
    )
    inputs = tuple(Place(item.name, item.name, INPUT, of=item.name, variables=(item.name,)) for item in model.inputs)
    sensors = tuple(
        Place(f"{item.name} sensor", item.name, SENSOR, of=item.name, variables=(item.name,)) for item in model.outputs
    )
    return (*sources, *inputs, *sensors)
