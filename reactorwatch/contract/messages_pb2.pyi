from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Quality(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    QUALITY_UNSPECIFIED: _ClassVar[Quality]
    QUALITY_GOOD: _ClassVar[Quality]
    QUALITY_UNCERTAIN: _ClassVar[Quality]
    QUALITY_BAD: _ClassVar[Quality]

class AlarmState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ALARM_STATE_UNSPECIFIED: _ClassVar[AlarmState]
    ALARM_STATE_NORMAL: _ClassVar[AlarmState]
    ALARM_STATE_UNACKNOWLEDGED: _ClassVar[AlarmState]
    ALARM_STATE_ACKNOWLEDGED: _ClassVar[AlarmState]
    ALARM_STATE_RETURNED_UNACKNOWLEDGED: _ClassVar[AlarmState]
    ALARM_STATE_SHELVED: _ClassVar[AlarmState]
    ALARM_STATE_SUPPRESSED_BY_DESIGN: _ClassVar[AlarmState]
    ALARM_STATE_OUT_OF_SERVICE: _ClassVar[AlarmState]

class Priority(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PRIORITY_UNSPECIFIED: _ClassVar[Priority]
    PRIORITY_LOW: _ClassVar[Priority]
    PRIORITY_MEDIUM: _ClassVar[Priority]
    PRIORITY_HIGH: _ClassVar[Priority]
    PRIORITY_CRITICAL: _ClassVar[Priority]
QUALITY_UNSPECIFIED: Quality
QUALITY_GOOD: Quality
QUALITY_UNCERTAIN: Quality
QUALITY_BAD: Quality
ALARM_STATE_UNSPECIFIED: AlarmState
ALARM_STATE_NORMAL: AlarmState
ALARM_STATE_UNACKNOWLEDGED: AlarmState
ALARM_STATE_ACKNOWLEDGED: AlarmState
ALARM_STATE_RETURNED_UNACKNOWLEDGED: AlarmState
ALARM_STATE_SHELVED: AlarmState
ALARM_STATE_SUPPRESSED_BY_DESIGN: AlarmState
ALARM_STATE_OUT_OF_SERVICE: AlarmState
PRIORITY_UNSPECIFIED: Priority
PRIORITY_LOW: Priority
PRIORITY_MEDIUM: Priority
PRIORITY_HIGH: Priority
PRIORITY_CRITICAL: Priority

class Sample(_message.Message):
    __slots__ = ("time_ns", "sequence", "value", "unit", "quality")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    sequence: int
    value: float
    unit: str
    quality: Quality
    def __init__(self, time_ns: _Optional[int] = ..., sequence: _Optional[int] = ..., value: _Optional[float] = ..., unit: _Optional[str] = ..., quality: _Optional[_Union[Quality, str]] = ...) -> None: ...

class Estimate(_message.Message):
    __slots__ = ("time_ns", "prediction", "residual", "residual_sd", "lower_limit", "upper_limit", "unit")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    PREDICTION_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_FIELD_NUMBER: _ClassVar[int]
    RESIDUAL_SD_FIELD_NUMBER: _ClassVar[int]
    LOWER_LIMIT_FIELD_NUMBER: _ClassVar[int]
    UPPER_LIMIT_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    prediction: float
    residual: float
    residual_sd: float
    lower_limit: float
    upper_limit: float
    unit: str
    def __init__(self, time_ns: _Optional[int] = ..., prediction: _Optional[float] = ..., residual: _Optional[float] = ..., residual_sd: _Optional[float] = ..., lower_limit: _Optional[float] = ..., upper_limit: _Optional[float] = ..., unit: _Optional[str] = ...) -> None: ...

class ModelSnapshot(_message.Message):
    __slots__ = ("time_ns", "structure", "order", "delay", "parameters", "rows", "forgetting", "excitation", "condition", "reference", "checks", "held")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    STRUCTURE_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    DELAY_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    FORGETTING_FIELD_NUMBER: _ClassVar[int]
    EXCITATION_FIELD_NUMBER: _ClassVar[int]
    CONDITION_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    CHECKS_FIELD_NUMBER: _ClassVar[int]
    HELD_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    structure: str
    order: int
    delay: int
    parameters: _containers.RepeatedCompositeFieldContainer[Parameter]
    rows: int
    forgetting: float
    excitation: float
    condition: float
    reference: bool
    checks: _containers.RepeatedCompositeFieldContainer[Check]
    held: bool
    def __init__(self, time_ns: _Optional[int] = ..., structure: _Optional[str] = ..., order: _Optional[int] = ..., delay: _Optional[int] = ..., parameters: _Optional[_Iterable[_Union[Parameter, _Mapping]]] = ..., rows: _Optional[int] = ..., forgetting: _Optional[float] = ..., excitation: _Optional[float] = ..., condition: _Optional[float] = ..., reference: bool = ..., checks: _Optional[_Iterable[_Union[Check, _Mapping]]] = ..., held: bool = ...) -> None: ...

class Parameter(_message.Message):
    __slots__ = ("name", "value", "sd")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    SD_FIELD_NUMBER: _ClassVar[int]
    name: str
    value: float
    sd: float
    def __init__(self, name: _Optional[str] = ..., value: _Optional[float] = ..., sd: _Optional[float] = ...) -> None: ...

class Check(_message.Message):
    __slots__ = ("name", "result")
    NAME_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    name: str
    result: str
    def __init__(self, name: _Optional[str] = ..., result: _Optional[str] = ...) -> None: ...

class ChartPoint(_message.Message):
    __slots__ = ("time_ns", "statistic", "centre", "lower_limit", "upper_limit", "out")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    STATISTIC_FIELD_NUMBER: _ClassVar[int]
    CENTRE_FIELD_NUMBER: _ClassVar[int]
    LOWER_LIMIT_FIELD_NUMBER: _ClassVar[int]
    UPPER_LIMIT_FIELD_NUMBER: _ClassVar[int]
    OUT_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    statistic: float
    centre: float
    lower_limit: float
    upper_limit: float
    out: bool
    def __init__(self, time_ns: _Optional[int] = ..., statistic: _Optional[float] = ..., centre: _Optional[float] = ..., lower_limit: _Optional[float] = ..., upper_limit: _Optional[float] = ..., out: bool = ...) -> None: ...

class Alarm(_message.Message):
    __slots__ = ("time_ns", "alarm", "state", "priority", "raised_ns", "cleared_ns", "value", "limit", "unit", "contributions", "suspects", "text", "event", "incident", "first_in", "shelved_until_ns", "comment", "by", "names_cause")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    ALARM_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    RAISED_NS_FIELD_NUMBER: _ClassVar[int]
    CLEARED_NS_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    CONTRIBUTIONS_FIELD_NUMBER: _ClassVar[int]
    SUSPECTS_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    EVENT_FIELD_NUMBER: _ClassVar[int]
    INCIDENT_FIELD_NUMBER: _ClassVar[int]
    FIRST_IN_FIELD_NUMBER: _ClassVar[int]
    SHELVED_UNTIL_NS_FIELD_NUMBER: _ClassVar[int]
    COMMENT_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    NAMES_CAUSE_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    alarm: str
    state: AlarmState
    priority: Priority
    raised_ns: int
    cleared_ns: int
    value: float
    limit: float
    unit: str
    contributions: _containers.RepeatedCompositeFieldContainer[Contribution]
    suspects: _containers.RepeatedCompositeFieldContainer[Suspect]
    text: str
    event: str
    incident: int
    first_in: bool
    shelved_until_ns: int
    comment: str
    by: str
    names_cause: bool
    def __init__(self, time_ns: _Optional[int] = ..., alarm: _Optional[str] = ..., state: _Optional[_Union[AlarmState, str]] = ..., priority: _Optional[_Union[Priority, str]] = ..., raised_ns: _Optional[int] = ..., cleared_ns: _Optional[int] = ..., value: _Optional[float] = ..., limit: _Optional[float] = ..., unit: _Optional[str] = ..., contributions: _Optional[_Iterable[_Union[Contribution, _Mapping]]] = ..., suspects: _Optional[_Iterable[_Union[Suspect, _Mapping]]] = ..., text: _Optional[str] = ..., event: _Optional[str] = ..., incident: _Optional[int] = ..., first_in: bool = ..., shelved_until_ns: _Optional[int] = ..., comment: _Optional[str] = ..., by: _Optional[str] = ..., names_cause: bool = ...) -> None: ...

class Incident(_message.Message):
    __slots__ = ("time_ns", "number", "since_ns", "until_ns", "state", "alarms", "suspects", "text")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    SINCE_NS_FIELD_NUMBER: _ClassVar[int]
    UNTIL_NS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    ALARMS_FIELD_NUMBER: _ClassVar[int]
    SUSPECTS_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    number: int
    since_ns: int
    until_ns: int
    state: AlarmState
    alarms: _containers.RepeatedScalarFieldContainer[str]
    suspects: _containers.RepeatedCompositeFieldContainer[Suspect]
    text: str
    def __init__(self, time_ns: _Optional[int] = ..., number: _Optional[int] = ..., since_ns: _Optional[int] = ..., until_ns: _Optional[int] = ..., state: _Optional[_Union[AlarmState, str]] = ..., alarms: _Optional[_Iterable[str]] = ..., suspects: _Optional[_Iterable[_Union[Suspect, _Mapping]]] = ..., text: _Optional[str] = ...) -> None: ...

class AlarmKpis(_message.Message):
    __slots__ = ("time_ns", "alarms_10min", "flood", "chattering", "standing", "stale", "priorities", "unacknowledged", "shelved", "suppressed", "out_of_service", "incidents")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    ALARMS_10MIN_FIELD_NUMBER: _ClassVar[int]
    FLOOD_FIELD_NUMBER: _ClassVar[int]
    CHATTERING_FIELD_NUMBER: _ClassVar[int]
    STANDING_FIELD_NUMBER: _ClassVar[int]
    STALE_FIELD_NUMBER: _ClassVar[int]
    PRIORITIES_FIELD_NUMBER: _ClassVar[int]
    UNACKNOWLEDGED_FIELD_NUMBER: _ClassVar[int]
    SHELVED_FIELD_NUMBER: _ClassVar[int]
    SUPPRESSED_FIELD_NUMBER: _ClassVar[int]
    OUT_OF_SERVICE_FIELD_NUMBER: _ClassVar[int]
    INCIDENTS_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    alarms_10min: int
    flood: bool
    chattering: _containers.RepeatedScalarFieldContainer[str]
    standing: _containers.RepeatedScalarFieldContainer[str]
    stale: _containers.RepeatedScalarFieldContainer[str]
    priorities: _containers.RepeatedCompositeFieldContainer[PriorityCount]
    unacknowledged: int
    shelved: int
    suppressed: int
    out_of_service: int
    incidents: int
    def __init__(self, time_ns: _Optional[int] = ..., alarms_10min: _Optional[int] = ..., flood: bool = ..., chattering: _Optional[_Iterable[str]] = ..., standing: _Optional[_Iterable[str]] = ..., stale: _Optional[_Iterable[str]] = ..., priorities: _Optional[_Iterable[_Union[PriorityCount, _Mapping]]] = ..., unacknowledged: _Optional[int] = ..., shelved: _Optional[int] = ..., suppressed: _Optional[int] = ..., out_of_service: _Optional[int] = ..., incidents: _Optional[int] = ...) -> None: ...

class PriorityCount(_message.Message):
    __slots__ = ("priority", "raised", "standing")
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    RAISED_FIELD_NUMBER: _ClassVar[int]
    STANDING_FIELD_NUMBER: _ClassVar[int]
    priority: Priority
    raised: int
    standing: int
    def __init__(self, priority: _Optional[_Union[Priority, str]] = ..., raised: _Optional[int] = ..., standing: _Optional[int] = ...) -> None: ...

class Contribution(_message.Message):
    __slots__ = ("signal", "share")
    SIGNAL_FIELD_NUMBER: _ClassVar[int]
    SHARE_FIELD_NUMBER: _ClassVar[int]
    signal: str
    share: float
    def __init__(self, signal: _Optional[str] = ..., share: _Optional[float] = ...) -> None: ...

class Suspect(_message.Message):
    __slots__ = ("cause", "probability", "profile", "size", "size_sd", "unit", "onset_ns", "onset_sd_min", "kind", "text")
    CAUSE_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    PROFILE_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    SIZE_SD_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    ONSET_NS_FIELD_NUMBER: _ClassVar[int]
    ONSET_SD_MIN_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    cause: str
    probability: float
    profile: str
    size: float
    size_sd: float
    unit: str
    onset_ns: int
    onset_sd_min: float
    kind: str
    text: str
    def __init__(self, cause: _Optional[str] = ..., probability: _Optional[float] = ..., profile: _Optional[str] = ..., size: _Optional[float] = ..., size_sd: _Optional[float] = ..., unit: _Optional[str] = ..., onset_ns: _Optional[int] = ..., onset_sd_min: _Optional[float] = ..., kind: _Optional[str] = ..., text: _Optional[str] = ...) -> None: ...

class Reconstruction(_message.Message):
    __slots__ = ("time_ns", "value", "sd", "unit", "measured", "cause")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    SD_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    CAUSE_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    value: float
    sd: float
    unit: str
    measured: float
    cause: str
    def __init__(self, time_ns: _Optional[int] = ..., value: _Optional[float] = ..., sd: _Optional[float] = ..., unit: _Optional[str] = ..., measured: _Optional[float] = ..., cause: _Optional[str] = ...) -> None: ...

class Health(_message.Message):
    __slots__ = ("time_ns", "node", "version", "phase", "uptime_s", "received", "lost", "late", "refused", "refused_by_reason", "lag_ms", "duplicated", "out_of_order", "published", "rows", "incomplete_rows", "heard_from_ns", "not_stored", "stalls", "reference", "training", "failures", "waiting_for")
    class RefusedByReasonEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class HeardFromNsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class FailuresEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    NODE_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    LOST_FIELD_NUMBER: _ClassVar[int]
    LATE_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_BY_REASON_FIELD_NUMBER: _ClassVar[int]
    LAG_MS_FIELD_NUMBER: _ClassVar[int]
    DUPLICATED_FIELD_NUMBER: _ClassVar[int]
    OUT_OF_ORDER_FIELD_NUMBER: _ClassVar[int]
    PUBLISHED_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    INCOMPLETE_ROWS_FIELD_NUMBER: _ClassVar[int]
    HEARD_FROM_NS_FIELD_NUMBER: _ClassVar[int]
    NOT_STORED_FIELD_NUMBER: _ClassVar[int]
    STALLS_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    TRAINING_FIELD_NUMBER: _ClassVar[int]
    FAILURES_FIELD_NUMBER: _ClassVar[int]
    WAITING_FOR_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    node: str
    version: str
    phase: str
    uptime_s: float
    received: int
    lost: int
    late: int
    refused: int
    refused_by_reason: _containers.ScalarMap[str, int]
    lag_ms: float
    duplicated: int
    out_of_order: int
    published: int
    rows: int
    incomplete_rows: int
    heard_from_ns: _containers.ScalarMap[str, int]
    not_stored: int
    stalls: int
    reference: str
    training: float
    failures: _containers.ScalarMap[str, int]
    waiting_for: str
    def __init__(self, time_ns: _Optional[int] = ..., node: _Optional[str] = ..., version: _Optional[str] = ..., phase: _Optional[str] = ..., uptime_s: _Optional[float] = ..., received: _Optional[int] = ..., lost: _Optional[int] = ..., late: _Optional[int] = ..., refused: _Optional[int] = ..., refused_by_reason: _Optional[_Mapping[str, int]] = ..., lag_ms: _Optional[float] = ..., duplicated: _Optional[int] = ..., out_of_order: _Optional[int] = ..., published: _Optional[int] = ..., rows: _Optional[int] = ..., incomplete_rows: _Optional[int] = ..., heard_from_ns: _Optional[_Mapping[str, int]] = ..., not_stored: _Optional[int] = ..., stalls: _Optional[int] = ..., reference: _Optional[str] = ..., training: _Optional[float] = ..., failures: _Optional[_Mapping[str, int]] = ..., waiting_for: _Optional[str] = ...) -> None: ...

class Baseline(_message.Message):
    __slots__ = ("time_ns", "what", "by", "why", "id", "model", "restored")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    WHAT_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    RESTORED_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    what: str
    by: str
    why: str
    id: int
    model: str
    restored: int
    def __init__(self, time_ns: _Optional[int] = ..., what: _Optional[str] = ..., by: _Optional[str] = ..., why: _Optional[str] = ..., id: _Optional[int] = ..., model: _Optional[str] = ..., restored: _Optional[int] = ...) -> None: ...

class Promise(_message.Message):
    __slots__ = ("time_ns", "expected", "expected_90", "checked_rows", "found_in_training", "expected_in_training", "kept", "can_keep_per_30_days", "text", "power", "rows", "found", "expected_so_far", "drifted")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_90_FIELD_NUMBER: _ClassVar[int]
    CHECKED_ROWS_FIELD_NUMBER: _ClassVar[int]
    FOUND_IN_TRAINING_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_IN_TRAINING_FIELD_NUMBER: _ClassVar[int]
    KEPT_FIELD_NUMBER: _ClassVar[int]
    CAN_KEEP_PER_30_DAYS_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    POWER_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    FOUND_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_SO_FAR_FIELD_NUMBER: _ClassVar[int]
    DRIFTED_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    expected: float
    expected_90: float
    checked_rows: int
    found_in_training: int
    expected_in_training: float
    kept: bool
    can_keep_per_30_days: float
    text: str
    power: _containers.RepeatedCompositeFieldContainer[Power]
    rows: int
    found: int
    expected_so_far: float
    drifted: bool
    def __init__(self, time_ns: _Optional[int] = ..., expected: _Optional[float] = ..., expected_90: _Optional[float] = ..., checked_rows: _Optional[int] = ..., found_in_training: _Optional[int] = ..., expected_in_training: _Optional[float] = ..., kept: bool = ..., can_keep_per_30_days: _Optional[float] = ..., text: _Optional[str] = ..., power: _Optional[_Iterable[_Union[Power, _Mapping]]] = ..., rows: _Optional[int] = ..., found: _Optional[int] = ..., expected_so_far: _Optional[float] = ..., drifted: bool = ...) -> None: ...

class Power(_message.Message):
    __slots__ = ("deviation", "unit", "profile", "within_10_min", "within_1_h", "within_1_day")
    DEVIATION_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    PROFILE_FIELD_NUMBER: _ClassVar[int]
    WITHIN_10_MIN_FIELD_NUMBER: _ClassVar[int]
    WITHIN_1_H_FIELD_NUMBER: _ClassVar[int]
    WITHIN_1_DAY_FIELD_NUMBER: _ClassVar[int]
    deviation: str
    unit: str
    profile: str
    within_10_min: float
    within_1_h: float
    within_1_day: float
    def __init__(self, deviation: _Optional[str] = ..., unit: _Optional[str] = ..., profile: _Optional[str] = ..., within_10_min: _Optional[float] = ..., within_1_h: _Optional[float] = ..., within_1_day: _Optional[float] = ...) -> None: ...

class Fault(_message.Message):
    __slots__ = ("time_ns", "cause", "specification", "active", "onset_ns")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    CAUSE_FIELD_NUMBER: _ClassVar[int]
    SPECIFICATION_FIELD_NUMBER: _ClassVar[int]
    ACTIVE_FIELD_NUMBER: _ClassVar[int]
    ONSET_NS_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    cause: str
    specification: str
    active: bool
    onset_ns: int
    def __init__(self, time_ns: _Optional[int] = ..., cause: _Optional[str] = ..., specification: _Optional[str] = ..., active: bool = ..., onset_ns: _Optional[int] = ...) -> None: ...

class Audit(_message.Message):
    __slots__ = ("time_ns", "command", "by", "accepted", "text", "request")
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    REQUEST_FIELD_NUMBER: _ClassVar[int]
    time_ns: int
    command: str
    by: str
    accepted: bool
    text: str
    request: str
    def __init__(self, time_ns: _Optional[int] = ..., command: _Optional[str] = ..., by: _Optional[str] = ..., accepted: bool = ..., text: _Optional[str] = ..., request: _Optional[str] = ...) -> None: ...

class SetInput(_message.Message):
    __slots__ = ("signal", "value", "by")
    SIGNAL_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    signal: str
    value: float
    by: str
    def __init__(self, signal: _Optional[str] = ..., value: _Optional[float] = ..., by: _Optional[str] = ...) -> None: ...

class InjectFault(_message.Message):
    __slots__ = ("specification", "by")
    SPECIFICATION_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    specification: str
    by: str
    def __init__(self, specification: _Optional[str] = ..., by: _Optional[str] = ...) -> None: ...

class ClearFault(_message.Message):
    __slots__ = ("cause", "by")
    CAUSE_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    cause: str
    by: str
    def __init__(self, cause: _Optional[str] = ..., by: _Optional[str] = ...) -> None: ...

class AlarmCommand(_message.Message):
    __slots__ = ("alarm", "by", "comment", "incident")
    ALARM_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    COMMENT_FIELD_NUMBER: _ClassVar[int]
    INCIDENT_FIELD_NUMBER: _ClassVar[int]
    alarm: str
    by: str
    comment: str
    incident: int
    def __init__(self, alarm: _Optional[str] = ..., by: _Optional[str] = ..., comment: _Optional[str] = ..., incident: _Optional[int] = ...) -> None: ...

class ShelveAlarm(_message.Message):
    __slots__ = ("alarm", "by", "comment", "minutes")
    ALARM_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    COMMENT_FIELD_NUMBER: _ClassVar[int]
    MINUTES_FIELD_NUMBER: _ClassVar[int]
    alarm: str
    by: str
    comment: str
    minutes: float
    def __init__(self, alarm: _Optional[str] = ..., by: _Optional[str] = ..., comment: _Optional[str] = ..., minutes: _Optional[float] = ...) -> None: ...

class ListAlarms(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class BaselineCommand(_message.Message):
    __slots__ = ("what", "by", "why", "id")
    WHAT_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    what: str
    by: str
    why: str
    id: int
    def __init__(self, what: _Optional[str] = ..., by: _Optional[str] = ..., why: _Optional[str] = ..., id: _Optional[int] = ...) -> None: ...

class CommandReply(_message.Message):
    __slots__ = ("accepted", "text", "alarms", "baselines")
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    ALARMS_FIELD_NUMBER: _ClassVar[int]
    BASELINES_FIELD_NUMBER: _ClassVar[int]
    accepted: bool
    text: str
    alarms: _containers.RepeatedCompositeFieldContainer[Alarm]
    baselines: _containers.RepeatedCompositeFieldContainer[Baseline]
    def __init__(self, accepted: bool = ..., text: _Optional[str] = ..., alarms: _Optional[_Iterable[_Union[Alarm, _Mapping]]] = ..., baselines: _Optional[_Iterable[_Union[Baseline, _Mapping]]] = ...) -> None: ...
