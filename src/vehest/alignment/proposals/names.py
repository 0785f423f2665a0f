"""Roles that a name suggests: channels, ``az``, ``heading``, ``latitude``, ``longitude``,
``position_x`` and ``_y``, ``other``.

Names are compared in lower case without marks, umlauts and units in brackets; patterns are English
and German, as loggers of both languages write them. A strong hint is a name of its own, a weak one
is shared with other quantities.
"""

from __future__ import annotations

import re
from functools import cache

STRONG = 4.0  # score of a role that a name states
WEAK = 2.0  # score of a role that a name may state

# role -> pattern of names that state it, searched for in the name without blanks
_STRONG = {  # role -> pattern, searched for in the name without blanks
    "other": (
        r"temp(?!o)|oilp|gear|^gang|gang$|thrott|pedal|gaspe|drossel|volt|batt|sats?$|satel|qual|"
        r"status|lapn|^lap|runde|dist|strecke|weg$|height|altit|hoehe|vertvel|cov|^rms|rms$|std|"
        r"jerk|ruck|fuel|tank|error|count|engn|engine|motordreh|^drehzahl|^rpm$|^nmot|"
        r"wind(?!igkeit)|susp|feder|damper|^id$|index|event|friction|accped|orientation|magnet|"
        r"flag|counter|zaehler|time|zeit|stamp|safety|^z$|posz$|positionz$|posez$|zpos$|offset$|"
        r"yawa(ng)?acc|^lean|lean(ang|winkel)|^bank|bank(ang|winkel)|bank$|schraegl|"
        r"yawangular|gierbeschl|angularacc|crosstrack|err$|fehler|abweichung|deviation|^ey$|^dlat$|"
        r"^epsi$|deltapsi|curvature|kruemm|kappa|^kpath$|crc|checksum|pruefsumme|bz$|^alive"
    ),
    "yaw_rate": (
        r"yawra?te?|ang(ular|le)?ratez|gierrate|giergeschw|gierwinkelgeschw|dpsi.|psidot|psip|"
        r"yawvel|lacet|gui[nñ]ada|imbardata|rateyaw|yawspeed|omegaz|angular(velocity)?z|"
        r"ang(ular|le)?ratedown|gyr(o)?z|^(imu)?[gw]z$|"
        r"^rimu$|psistrich|vgier|rotationratez|^zrateofrotation|angvelz|^wzimu$"
    ),
    "ay": (
        r"latac|latera?lac|acclat|acc(el|eleration)?y(?!aw)|querb|^ay(cg|imu|mps2|v)?$|alat$|^alat|"
        r"linearaccelerationy|yacc|glat|^gy$|quera(?!bw)|accquer|accel?lat|laterala|"
        r"ac+[eé]l\w*lat|beschl(eunigung)?(y|quer)|latg$|gforcelat|ayvehicle|accel?right|"
        r"latcomp|^aclny"
    ),
    "ax": r"longac|ac+[eé]l\w*long|inlineac|acclong|acc(el|eleration)?x|laengsb|langsb|lengthacc|"
    r"longitudinalac|"
    r"^ax(cg|imu|mps2|v)?$|along$|^along|algt|"
    r"linearaccelerationx|xacc|glong|^gx$|accl(a|ae)ngs|beschl(eunigung)?(x|l(a|ae)ngs)|longg$|"
    r"lonacc|acclon|gforcelon|axvehicle|accel?forward|longcomp|^aclnx",
    "az": r"acc(el|eleration)?z|zacc|^az$|verta|accvert",
    "handwheel": (
        r"lenkrad|^lrw|swa$|^swa|st(ee)?r?wh(ee)?l|steeringwheel|handwheel|handlenk|sas(ang)|stwhl|"
        r"steersw|volant|^lws?(winkel|ang)|^avlstea|^stepin"
    ),
    "steer": r"roadwheel|radeinschlag|deltaw|frontwheelangle|^delta|steer|lenk|whlang|servo|"
    r"^strang",
    "vy_ref": (
        r"^vy|^uy|vyc?g?$|vlat|latvel|velocitylat|lateralvel|latera?lspeed|vellat|vquer|quergeschw|"
        r"(vitesse|velocidad|velocità)lat|velocityy|(?<!t)yvel|linear_?y$|latspeed|"
        r"velocityvehicley|speedlat|vely"
    ),
    "sideslip_ref": (
        r"sideslip|slipang|slipcog|slipcg|^beta|beta$|schwimm|driftang|floatang|^slip$|"
        r"d[eé]riv[ea]$"
    ),
    "heading": (
        r"heading|truehead|course|bearing|angletrack|yawang|gierwinkel|^psi$|azimuth|^yaw$|"
        r"kurswinkel|headimu"
    ),
    "latitude": r"latitude|(gps|gnss|pos)lat$|^lat$|breitengrad",
    "longitude": r"longitude|(gps|gnss|pos)long?$|^long?$|^lng$|laengengrad",
    "position_x": r"^x$|posx$|positionx$|posex$|xpos$|viconx$|^xm$",
    "position_y": r"^y$|posy$|positiony$|posey$|ypos$|vicony$|^ym$",
    "vx": (
        r"speed|velocity|vitesse|velocidad|velocità|geschw|vehspd|^vx|^ux|vxc?g?$|vlong|vellong|"
        r"longvel|vfzg|tacho|velocityx|"
        r"xvel|linearx$|^kmh$|^mph$|velx|vlaengs|longitudinalvel|lngvel|velforward|forwardvel|"
        r"fahrzeugv|vehv|groundspd|vehicles?pd|encoder|vsignal|^vveh|^v(ref|gps|ist)$"
    ),
    "roll_rate": (
        r"rollra?te?|wankrate|ang(ular|le)?rate(x|forward)|angularvelocityx|omegax|gyr(o)?x|^[gw]x$"
    ),
    "pitch_rate": (
        r"pitchrate|ang(ular|le)?rate(y|lateral)|nickrate|angularvelocityy|omegay|gyr(o)?y|^[gw]y$"
    ),
    "roll": r"^roll|rollang|wankwinkel|^wank",
    "pitch": r"^pitch|pitchang|nickwinkel|^nick",
    "motor_current": r"^iq$|motorcurr|strommotor|^current$|avgiq",
}
# role -> pattern of names that may state it
_WEAK = {
    "yaw_rate": r"gyro|gier|dpsi|^r$|^w$|^omega$|yaw|wimu",
    "ay": r"quer$|^quer|lateral|^lat",
    "ax": r"laengs|langs|^longitudinal",
    "steer": r"^cmd$|^str$|steering",
    "vx": r"^v$|^u$|^tempo|spd|^vel|v$|wheelv|vwheel|omegawheels|^gs$|^sog$",
    "vy_ref": r"^v$|v$|quer",
    "sideslip_ref": r"slip",
    "heading": r"yaw|^phi$|head|^theta$",
}
# matches names of reference sensors
_REFERENCE = re.compile(
    r"ref|mocap|motioncap|gps|gnss|\bins\b|oxts|\brt ?\d|adma|correvit|corrsys|optical|optic|vicon|"
    r"optitrack|true|truth|\bgt\b|datron|s350|"
    r"kistler|vbox|satell|rigid|vehicle velocity|racelogic|novatel|\bimar\b|genesys|"
    r"from (yaw|pose|positions?)\b"
)
# matches names of signals on the car's own bus
_BUS = re.compile(
    r"\bcan\d?\b|\besp\b|\babs\b|\besc\b|\bobd|^veh(icle)?(spd|speed|sp)|^tacho|spdlgt|^alat\d|"
    r"^algt\d"
)
# matches names of frames of the world
_WORLD_FRAME = re.compile(r"\b(world|global|map|utm|earth)\b")
# matches names of quantities along an axis of the world, which no channel is
_WORLD_AXIS = re.compile(
    r"\b(east|north|down|ost|nord|ned|enu|ecef)(ward)?\b|(east|north|ecef)|"
    r"\b(v|vel|velocity|speed|spd|acc|acceleration)( ?[en]| d| up)$"
)
# matches names of rates of the steering angle
_STEERING_RATE = re.compile(
    r"deltadelta|steer(ing)?(wheel)?(angle)?(rate|speed|vel)|lenk\w*geschw|swarate|anglerate|"
    r"deltadot|ddelta"
)
# matches names of filtered signals
_FILTERED = re.compile(r"filt(er(ed)?)?|smooth|\blp\b|avg|mittel|gemittelt")
# matches words that say nothing on the quantity
_UNTELLING = re.compile(r"\b(body|bdy|frame|chassis|device)\b")
# matches names of set values
_SET_VALUE = re.compile(r"\b(target|soll|desired|demand(ed)?|set ?point|wunsch|cmd|command)|soll\b")
# matches names of quantities of a trailer
_TRAILER = re.compile(
    r"trailer|anhaenger|auflieger|\b(hitch|drawbar|deichsel|dolly|articulation)\b"
)
# matches names of estimates by a filter
_ESTIMATE = re.compile(r"\b([eu]?kf|kalman|est|estimate[ds]?|estimation|observer|beobachter)\b")
# wheel -> pattern of its names
_CORNERS = {
    "fl": r"fl|vl|lf|fro?nt ?le(?:ft)?|vorne? ?links|left ?front|avant ?gauche",
    "fr": r"fr|vr|rf|fro?nt ?ri(?:ght)?|vorne? ?rechts|right ?front|avant ?droite?",
    "rl": r"rl|hl|lr|re(?:ar)? ?le(?:ft)?|hinten ?links|left ?rear|arri[eè]re ?gauche",
    "rr": r"rr|hr|re(?:ar)? ?ri(?:ght)?|hinten ?rechts|right ?rear|arri[eè]re ?droite?",
}
# matches names of quantities of a wheel other than its speed
_NO_SPEED_OF_A_WHEEL = re.compile(
    r"tq|torq|moment|press|druck|slip|temp|susp|force|kraft|fx|fy|fz|brake|brems|lat|acc|angle|"
    r"winkel|disp|damp|tyre|tire"
)
# axle -> pattern of its names
_AXLES = {"front": r"front|\bf\b|vorne|\bva\b|brakef|fr?t\b", "rear": r"rear|\br\b|hint|\bha\b"}
# matches names of speeds of wheels
_WHEEL_SPEED = re.compile(
    r"wh(ee)?l|rad|roue|spd|speed|rpm|drehzahl|geschw|^[nvw]\b|\b[nvw]$|omega|\bws[ps]?\b|vel"
)
_EXPLAINED = {
    "yaw_rate": ("heading", "vx", "vy_ref", "position_x", "position_y"),
    "handwheel": ("steer",),
    "vy_ref": ("vx", "ay", "pitch_rate", "position_y"),
    "sideslip_ref": ("vx",),
    "ay": ("latitude", "vx", "vy_ref", "pitch_rate", "position_y"),
    "latitude": ("ay",),
    "ax": ("longitude", "vx", "roll_rate", "position_x"),
    "roll_rate": ("roll", "vx"),
    "pitch_rate": ("pitch", "vx"),
    "vx": ("ax", "vy_ref", "position_x", "position_y"),
    "heading": ("yaw_rate",),
}
"""Role -> roles that a part of its names suggests: the yaw in a yaw rate is no heading."""
# unit -> quantity
_QUANTITIES = {
    **dict.fromkeys(("m/s", "km/h", "mph", "knots"), "vel"),
    **dict.fromkeys(("m/s²", "g"), "acc"),
    **dict.fromkeys(("rad/s", "deg/s"), "rate"),
}
_UNITS_OF_WHEELS = ("m/s", "km/h", "mph", "rpm", "rad/s", "rev/s")  # units of wheel speeds
_NO_QUANTITY = ("heading", "latitude", "longitude", "position_x", "position_y")
"""Roles of angles and positions, which are in none of these units."""
# matches a unit at the end of a name
_WITHOUT_UNIT = re.compile(r" (km?p?h|mp[hs]|ms|kts?|kn|ms2|mps2|radps|rads|degps|degs|dps)$")
# letter -> its plain spelling
_PLAIN = str.maketrans(
    {
        "ä": "ae",
        "ö": "oe",
        "ü": "ue",
        "Ä": "Ae",
        "Ö": "Oe",
        "Ü": "Ue",
        "ß": "ss",
        "ψ": "psi",
        "β": "beta",
        "δ": "delta",
    }
)
# words of the longitudinal and the lateral of two names
_PAIRS = (
    ("x", "y"),
    ("u", "v"),
    ("long", "lat"),
    ("lng", "lat"),
    ("lon", "lat"),
    ("laengs", "quer"),
)


def bare(name: str) -> str:
    """A name in lower-case words without marks, umlauts and brackets with their content.

    Parameters
    ----------
    name : str
        Of a column, such as ``Gyro_Z [deg/s]``.

    Returns
    -------
    str
        Such as ``gyro z``; words begin at capitals within a name too.
    """
    text = (re.sub(r"[\[({<].*$", "", name) or name).translate(_PLAIN)
    text = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text)
    return re.sub(r"[\W_]+", " ", text).strip().lower()


@cache
def hints(name: str, unit: str = "") -> dict[str, float]:
    """Role -> `STRONG` or `WEAK`, for each role that a name suggests; a unit, as vehest spells it,
    tells the quantity.

    Parameters
    ----------
    name : str
        Of a column.
    unit : str
        As vehest spells it; empty if unknown.

    Returns
    -------
    dict
        A single entry for a wheel's speed, a brake pressure, or ``other``: a quantity that is no
        channel, or one along an axis of the world.
    """
    words = re.sub(r" {2,}", " ", _UNTELLING.sub("", _FILTERED.sub("", bare(name)))).strip()
    compact = words.replace(" ", "")
    without_unit = _WITHOUT_UNIT.sub("", words).replace(" ", "")
    texts = "\n".join(
        [
            compact,
            *([without_unit, without_unit + _QUANTITIES[unit]] if unit in _QUANTITIES else []),
        ]
    )
    corner = _corner(words) or _corner(f"{words} speed" if unit in _UNITS_OF_WHEELS else "")
    if corner:
        return {f"wheel_speed_{corner}": STRONG}
    if re.search(r"brake|brems", words) and re.search(r"press|druck|^p ?brake|bar$", words):
        axle = next((axle for axle, pattern in _AXLES.items() if re.search(pattern, words)), "")
        return {f"brake_pressure_{axle}" if axle else "other": STRONG}
    roles = {
        role: WEAK
        for role, pattern in _WEAK.items()
        if re.search(pattern, texts, re.MULTILINE)
        or re.search(rf"^(?:{pattern})$", words.rpartition(" ")[2])
    }
    roles |= {
        role: STRONG
        for role, pattern in _STRONG.items()
        if re.search(pattern, texts, re.MULTILINE) or role in words.split()
    }
    if unit in _QUANTITIES:
        roles = {role: strength for role, strength in roles.items() if role not in _NO_QUANTITY}
    strong = {role for role, strength in roles.items() if strength == STRONG}
    is_set_value = _SET_VALUE.search(words) and not {"steer", "handwheel"} & set(roles)
    if is_set_value or _TRAILER.search(words):
        return {"other": STRONG}
    is_in_world = _WORLD_FRAME.search(words) and {"vx", "vy_ref", "ax", "ay"} & set(roles)
    if is_in_world or (_WORLD_AXIS.search(words) and "yaw_rate" not in strong):
        return {"other": STRONG}
    is_other = "other" in strong and not strong & {
        "yaw_rate",
        "ay",
        "ax",
        "sideslip_ref",
        "vy_ref",
        "handwheel",
    }
    is_turning = strong & {"yaw_rate", "roll_rate", "pitch_rate"}
    if is_other or (_STEERING_RATE.search(compact) and not is_turning):
        return {"other": STRONG}
    parts = {
        part
        for role in strong
        for part in _EXPLAINED.get(role, ())
        if role not in ("vx", "latitude") or part not in strong
    }
    return {role: strength for role, strength in roles.items() if role not in {*parts, "other"}}


def _corner(words: str) -> str:
    """The wheel whose speed a name suggests; empty for other names."""
    if _NO_SPEED_OF_A_WHEEL.search(words):
        return ""
    for corner, pattern in _CORNERS.items():
        wheel = "wheel|whl|rad|spd|speed|vel|ws[ps]?|drehzahl"
        joined = rf"^(?:{pattern})(?:wh|rad|spd|speed|vel)|(?:{wheel})(?:{pattern})$"
        is_separate = re.search(rf"(?:^|\s)(?:{pattern})(?:$|\s)", words) and _WHEEL_SPEED.search(
            words
        )
        if is_separate or re.search(joined, words.replace(" ", "")):
            return corner
    return ""


def is_pair(longitudinal: str, lateral: str) -> bool:
    """Whether two names differ by x and y, u and v, or long and lat alone.

    Parameters
    ----------
    longitudinal, lateral : str
        Names of columns, in this order.
    """
    ahead = bare(longitudinal)
    across = bare(lateral)
    return ahead != across and any(
        re.sub(rf"{first}(?![a-z]*{first})", second, ahead) == across for first, second in _PAIRS
    )


def is_reference(name: str) -> bool:
    """Whether a name suggests a reference sensor."""
    return bool(
        _REFERENCE.search(bare(name))
        or re.search(r"gps|gnss|mocap|vicon", bare(name).replace(" ", ""))
    )


def is_of_bus(name: str) -> bool:
    """Whether a name suggests a signal on the car's own bus."""
    return bool(_BUS.search(bare(name)) or _BUS.search(bare(name).replace(" ", "")))


def is_estimate(name: str) -> bool:
    """Whether a name suggests that a filter estimated a channel and no sensor measured it."""
    return bool(_ESTIMATE.search(bare(name)))


def is_filtered(name: str) -> bool:
    """Whether a name suggests a filtered channel."""
    return bool(_FILTERED.search(bare(name)))
