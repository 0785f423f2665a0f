"""What a column's name says of it: English and German, in full and as loggers shorten them. A name is a hint and decides little alone."""

from __future__ import annotations

import re
from functools import cache

STRONG, WEAK = 4.0, 2.0

SPEED, YAW_RATE, AY, AX, STEER, HANDWHEEL = "speed", "yaw_rate", "ay", "ax", "steer", "handwheel"
LATERAL_VELOCITY, SIDESLIP, HEADING, LATITUDE, LONGITUDE, POSITION_X, POSITION_Y, OTHER = (
    *("lateral_velocity", "sideslip", "heading", "latitude", "longitude", "position_x", "position_y"),
    "other",
)

_STRONG = {  # over the name without blanks
    OTHER: r"temp|oilp|gear|^gang|gang$|thrott|pedal|gaspe|drossel|volt|batt|sats?$|satel|qual|status|lapn|^lap|runde|"
    r"dist|strecke|weg$|height|altit|hoehe|vertvel|cov|rms|std|jerk|ruck|fuel|tank|error|count|engn|engine|"
    r"motordreh|^drehzahl|^rpm$|^nmot|wind|susp|feder|damper|^id$|index|event|friction|accped|orientation|"
    r"magnet|flag|counter|zaehler|time|zeit|stamp|safety|yawa(ng)?acc|yawangular|gierbeschl|angularacc",
    YAW_RATE: r"yawra?te?|gierrate|giergeschw|gierwinkelgeschw|dpsi|psidot|psip|yawvel|rateyaw|yawspeed|omegaz|"
    r"angular(velocity)?z|gyr(o)?z|^(imu)?[gw]z$|^rimu$|psistrich|vgier",
    AY: r"latacc|latac|latera?lac|acclat|acc(el|eleration)?y|querb|querac|^ay(cg|imu|mps2|v)?$|alat$|^alat|"
    r"linearaccelerationy|yacc|glat|^gy$|quera|accquer|laterala|beschl(eunigung)?(y|quer)|latg$|gforcelat|"
    r"ayvehicle",
    AX: r"longacc|longac|longitudinalac|acclong|acc(el|eleration)?x|laengsb|langsb|lengthacc|^ax(cg|imu|mps2|v)?$|"
    r"along$|^along|algt|linearaccelerationx|xacc|glong|^gx$|accl(a|ae)ngs|beschl(eunigung)?(x|l(a|ae)ngs)|"
    r"longg$|lonacc|acclon|gforcelon|axvehicle",
    HANDWHEEL: r"lenkrad|^lrw|swa$|^swa|st(ee)?r?wh(ee)?l|steeringwheel|steerwheel|handwheel|handlenk|sas(ang)|stwhl|"
    r"volant",
    STEER: r"roadwheel|radeinschlag|deltaw|frontwheelangle|^delta|steer|lenkw|lenkung|lenk|whlang|servo",
    LATERAL_VELOCITY: r"^vy|vyc?g?$|vlat|latvel|velocitylat|lateralvel|latera?lspeed|vellat|vquer|quergeschw|velocityy|"
    r"linear_?y$|latspeed|velocityvehicley|speedlat|vely",
    SIDESLIP: r"sideslip|slipang|slipcog|slipcg|^beta|beta$|schwimm|driftang|floatang|^slip$",
    HEADING: r"heading|truehead|course|yawang|gierwinkel|^psi$|azimuth|^yaw$|kurswinkel|headimu",
    LATITUDE: r"latitude|gpslat$|^lat$|breitengrad",
    LONGITUDE: r"longitude|gpslong?$|^long?$|^lng$|laengengrad",
    POSITION_X: r"^x$|posx$|positionx$|posex$|xpos$|viconx$|^xm$",
    POSITION_Y: r"^y$|posy$|positiony$|posey$|ypos$|vicony$|^ym$",
    SPEED: r"speed|velocity|geschw|vehspd|^vx|vxc?g?$|vlong|vellong|longvel|vfzg|tacho|velocityx|linearx$|^kmh$|^mph$|"
    r"velx|vlaengs|longitudinalvel|lngvel|fahrzeugv|vehv|groundspd|vehicles?pd|encoder",
    "roll_rate": r"rollrate|rollra?te?|wankrate|angularvelocityx|omegax|gyr(o)?x|^[gw]x$",
    "pitch_rate": r"pitchrate|nickrate|angularvelocityy|omegay|gyr(o)?y|^[gw]y$",
    "roll": r"^roll|rollang|wankwinkel|^wank",
    "pitch": r"^pitch|pitchang|nickwinkel|^nick",
    "motor_current": r"^iq$|motorcurr|strommotor|^current$|avgiq",
}
_WEAK = {
    YAW_RATE: r"gyro|gier|^r$|^w$|^omega$|yaw|wimu",
    AY: r"quer$|^quer|lateral|^lat",
    AX: r"laengs|langs|^longitudinal",
    STEER: r"^cmd$|^str$|steering",
    SPEED: r"^v$|^u$|spd|^vel|v$|wheelv|vwheel|omegawheels|^gs$|^sog$",
    LATERAL_VELOCITY: r"^v$|v$|quer",
    SIDESLIP: r"slip",
    HEADING: r"yaw|^phi$|head|^theta$",
}
_REFERENCE = re.compile(
    r"ref|mocap|motioncap|gps|gnss|\bins\b|oxts|\brt ?\d|adma|correvit|corrsys|optical|optic|vicon|optitrack|true|truth|\bgt\b|datron|s350|"
    r"kistler|vbox|satell|rigid|vehicle velocity|racelogic|novatel|\bimar\b|genesys|"
    r"from (yaw|pose|positions?)\b"
)
_STEERING_RATE = re.compile(r"deltadelta|steer(ing)?(wheel)?(angle)?(rate|speed|vel)|lenk\w*geschw|swarate|anglerate|deltadot|ddelta")
_FILTERED = re.compile(r"filt|smooth|\blp\b|avg|mittel|gemittelt")
_CORNERS = {
    "fl": r"fl|vl|lf|front ?left|vorne? ?links|left ?front",
    "fr": r"fr|vr|rf|front ?right|vorne? ?rechts|right ?front",
    "rl": r"rl|hl|lr|rear ?left|hinten ?links|left ?rear",
    "rr": r"rr|hr|rear ?right|hinten ?rechts|right ?rear",
}
_NO_SPEED_OF_A_WHEEL = re.compile(
    r"tq|torq|moment|press|druck|slip|temp|susp|force|kraft|fx|fy|fz|brake|brems|lat|acc|angle|winkel|disp|damp|tyre|tire"
)


def bare(name: str) -> str:
    """A name in lower-case words without marks, umlauts and what stands in brackets."""
    text = re.sub(r"[\[({<].*$", "", name) or name
    for letter, plain in {
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
    }.items():
        text = text.replace(letter, plain)
    text = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text)
    return re.sub(r"[\W_]+", " ", text).strip().lower()


@cache
def hints(name: str) -> dict[str, float]:
    """What a name speaks for: role -> `STRONG` or `WEAK`; a wheel's role is ``wheel_speed_fl`` and so on."""
    words = _FILTERED.sub("", bare(name)).strip()
    compact = re.sub(r"(ered)?$", "", words.replace(" ", "")) if is_filtered(name) else words.replace(" ", "")
    corner = corner_of(words)
    if corner:
        return {f"wheel_speed_{corner}": STRONG}
    if re.search(r"brake|brems", words) and re.search(r"press|druck|^p ?brake|bar$", words):
        axle = (
            "front"
            if re.search(r"front|\bf\b|vorne|\bva\b|brakef|fr?t\b", words)
            else "rear"
            if re.search(r"rear|\br\b|hint|\bha\b", words)
            else ""
        )
        return {f"brake_pressure_{axle}": STRONG} if axle else {OTHER: STRONG}
    found: dict[str, float] = {}
    for table, score in ((_WEAK, WEAK), (_STRONG, STRONG)):
        for role, pattern in table.items():
            if re.search(pattern, compact) or (score == WEAK and re.search(rf"^(?:{pattern})$", words.rpartition(" ")[2])):
                found[role] = score
    return _settled(found, compact)


def _settled(found: dict[str, float], compact: str) -> dict[str, float]:
    """Without what a longer word explains: the yaw in a yaw rate is no heading, a lateral velocity no speed."""
    strong = {role for role, score in found.items() if score == STRONG}
    if OTHER in strong and not strong & {YAW_RATE, AY, AX, SIDESLIP, LATERAL_VELOCITY, HANDWHEEL}:
        return {OTHER: STRONG}
    found.pop(OTHER, None)
    for role, others in {
        YAW_RATE: (HEADING, SPEED, LATERAL_VELOCITY, POSITION_X, POSITION_Y),
        HANDWHEEL: (STEER,),
        LATERAL_VELOCITY: (SPEED, AY, "pitch_rate", POSITION_Y),
        SIDESLIP: (SPEED,),
        AY: (LATITUDE, SPEED, LATERAL_VELOCITY, "pitch_rate", POSITION_Y),
        AX: (LONGITUDE, SPEED, "roll_rate", POSITION_X),
        "roll_rate": ("roll", SPEED),
        "pitch_rate": ("pitch", SPEED),
        SPEED: (AX, LATERAL_VELOCITY, POSITION_X, POSITION_Y),
        HEADING: (YAW_RATE,),
    }.items():
        if role in strong:
            for other in others:
                if found.get(other, 0.0) <= STRONG and not (role == SPEED and other in strong):
                    found.pop(other, None)
    if _STEERING_RATE.search(compact) and YAW_RATE not in strong:
        return {OTHER: STRONG}
    return found


def corner_of(words: str) -> str:
    """Which wheel's speed a name is; empty where it is none."""
    if _NO_SPEED_OF_A_WHEEL.search(words):
        return ""
    for corner, pattern in _CORNERS.items():
        apart = re.search(rf"(?:^|\s)(?:{pattern})(?:$|\s)", words)
        joined = re.search(
            rf"^(?:{pattern})(?:wh|rad|spd)|(?:wheel|whl|rad|spd|speed|vel|ws|drehzahl)(?:{pattern})$", words.replace(" ", "")
        )
        if joined or (apart and re.search(r"wh(ee)?l|rad|spd|speed|rpm|drehzahl|geschw|^[nvw]\b|\b[nvw]$|omega|\bws\b|vel", words)):
            return corner
    return ""


def pair_of(longitudinal: str, lateral: str) -> bool:
    """Whether two names are one but for x and y, u and v, or long and lat."""
    words = bare(longitudinal), bare(lateral)
    swapped = (("x", "y"), ("u", "v"), ("long", "lat"), ("lng", "lat"), ("lon", "lat"), ("laengs", "quer"))
    return any(
        words[0] != words[1] and re.sub(rf"{one}(?![a-z]*{one})", other, words[0]) == words[1] for one, other in swapped if one in words[0]
    )


def is_reference(name: str) -> bool:
    """Whether a name tells of a reference sensor."""
    return bool(_REFERENCE.search(bare(name))) or bool(re.search(r"gps|gnss|mocap|vicon", bare(name).replace(" ", "")))


def is_filtered(name: str) -> bool:
    """Whether a name tells of a channel that somebody has filtered."""
    return bool(_FILTERED.search(bare(name)))
