"""Every operation that has C: its number in CasADi, and an expression that is made by it."""

import casadi as ca

X, Y = ca.SX.sym("x"), ca.SX.sym("y")

EXACT = {
    "add": (ca.OP_ADD, X + Y),
    "sub": (ca.OP_SUB, X - Y),
    "mul": (ca.OP_MUL, X * Y),
    "div": (ca.OP_DIV, X / Y),
    "neg": (ca.OP_NEG, -X),
    "sq": (ca.OP_SQ, X**2),
    "twice": (ca.OP_TWICE, 2 * X),
    "inv": (ca.OP_INV, 1 / X),
    "lt": (ca.OP_LT, X < Y),
    "le": (ca.OP_LE, X <= Y),
    "eq": (ca.OP_EQ, X == Y),
    "ne": (ca.OP_NE, X != Y),
    "not": (ca.OP_NOT, ca.logic_not(X)),
    "and": (ca.OP_AND, ca.logic_and(X, Y)),
    "or": (ca.OP_OR, ca.logic_or(X, Y)),
    "if_else": (ca.OP_IF_ELSE_ZERO, ca.if_else(X < Y, X, Y)),
    "if_else_zero": (ca.OP_IF_ELSE_ZERO, ca.if_else(X, Y, 0)),
    "fmin": (ca.OP_FMIN, ca.fmin(X, Y)),
    "fmax": (ca.OP_FMAX, ca.fmax(X, Y)),
    "fabs": (ca.OP_FABS, ca.fabs(X)),
    "sign": (ca.OP_SIGN, ca.sign(X)),
    "sqrt": (ca.OP_SQRT, ca.sqrt(X)),
    "floor": (ca.OP_FLOOR, ca.floor(X)),
    "ceil": (ca.OP_CEIL, ca.ceil(X)),
    "copysign": (ca.OP_COPYSIGN, ca.copysign(X, Y)),
}
"""What arithmetic and the standard define to the last bit."""
ROUNDED = {
    "sin": (ca.OP_SIN, ca.sin(X)),
    "cos": (ca.OP_COS, ca.cos(X)),
    "tan": (ca.OP_TAN, ca.tan(X)),
    "asin": (ca.OP_ASIN, ca.asin(X)),
    "acos": (ca.OP_ACOS, ca.acos(X)),
    "atan": (ca.OP_ATAN, ca.atan(X)),
    "sinh": (ca.OP_SINH, ca.sinh(X)),
    "cosh": (ca.OP_COSH, ca.cosh(X)),
    "tanh": (ca.OP_TANH, ca.tanh(X)),
    "exp": (ca.OP_EXP, ca.exp(X)),
    "log": (ca.OP_LOG, ca.log(X)),
    "atan2": (ca.OP_ATAN2, ca.atan2(X, Y)),
    "pow": (ca.OP_POW, X**Y),
    "constpow": (ca.OP_CONSTPOW, X**2.5),
}
"""What libraries round as they like, within 4 units in the last place."""
OPERATIONS = EXACT | ROUNDED
