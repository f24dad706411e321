"""Access: identities and their secrets, tokens and the keys that sign them, limits of rate.

A secret is 256 random bits, shown once; the store has its hash. It is exchanged for a bearer token
that lives for minutes, and a refresh token that is good for one use. Tokens are signed with
Ed25519, so that nodes verify the tokens of sessions with public keys alone.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
import time
from collections.abc import Callable
from typing import Any

import jwt
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from jwt.algorithms import OKPAlgorithm

from cavmarl.service.error_names import problem
from cavmarl.service.event_log import EventLog
from cavmarl.service.service_records import IdentityRecord, Role, SessionRecord

ISSUER = "cavmarl"
AUDIENCE = "cavmarl.service"
ALGORITHM = "EdDSA"
ACCESS_S = 900.0
REFRESH_S = 8 * 3600.0
KEYS_KEPT = 2  # whose tokens are taken: the present one and the one before
MOST_VERIFIED = 10_000


class Access:
    """The caller's identity, as the log says."""

    def __init__(self, log: EventLog, wall_s: Callable[[], float] = time.time) -> None:
        self._log = log
        self._wall_s = wall_s
        self._verified: dict[str, tuple[str, int, float]] = {}  # signatures that were checked
        if not log.state.keys:
            self.rotate_key()
        self._load_keys()

    def add_identity(
        self, name: str, role: Role, actor: str = "service"
    ) -> tuple[IdentityRecord, str]:
        """A new identity and its secret, which nothing can show again."""
        there = [one for one in self._log.state.identities.values() if one.name == name]
        if any(not one.revoked for one in there):
            raise problem("conflict", f"identity '{name}' is there already: give another name")
        number = f"id-{secrets.token_hex(8)}"
        secret = f"cav.{number}.{secrets.token_urlsafe(32)}"
        data, private = {"name": name, "role": role}, {"digest": _digest(secret)}
        self._log.record("identity.added", number, data, actor=actor, private=private)
        return self._log.state.identities[number], secret

    def revoke(self, number: str, actor: str) -> None:
        """Void an identity: its secret and all its tokens."""
        identity = self._identity(number)
        others = [
            one
            for one in self._log.state.identities.values()
            if one.role == "admin" and not one.revoked and one.id != number
        ]
        if identity.role == "admin" and not others:
            raise problem("conflict", "the last admin cannot be revoked: add another one first")
        self._log.record("identity.revoked", number, actor=actor)

    def rotate_key(self, actor: str = "service") -> str:
        """Sign with a new key from now on; its id."""
        key = Ed25519PrivateKey.generate()
        pem = key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        ).decode()
        number = f"key-{secrets.token_hex(4)}"
        self._log.record("key.added", number, actor=actor, private={"pem": pem})
        self._load_keys()
        return number

    def public_keys(self) -> dict[str, Any]:
        """The keys that verify tokens, as a JSON Web Key Set."""
        keys = []
        for number, key in self._keys.items():
            found = json.loads(OKPAlgorithm.to_jwk(key.public_key()))
            keys.append({**found, "kid": number, "alg": ALGORITHM, "use": "sig"})
        return {"keys": keys}

    def exchange(self, secret: str) -> dict[str, Any]:
        """Tokens for a secret."""
        return self._tokens(self._by_secret(secret))

    def refresh(self, refresh_token: str) -> dict[str, Any]:
        """Tokens for a refresh token that was not used yet."""
        claims = self._verify(refresh_token, "refresh")
        identity = self._identity(claims["sub"])
        if claims["jti"] in identity.used:  # it was stolen, or its answer was
            self._log.record("identity.withdrawn", identity.id)
            raise problem("bad-token", "the refresh token was used before: all tokens are void now")
        data = {"token": claims["jti"], "expires_s": claims["exp"]}
        self._log.record("identity.refreshed", identity.id, data, actor=identity.id)
        return self._tokens(identity)

    def withdraw(self, identity: IdentityRecord) -> None:
        """Void all tokens of an identity; its secret stays."""
        self._log.record("identity.withdrawn", identity.id, actor=identity.id)

    def authenticate(self, token: str) -> IdentityRecord:
        """The identity that an access token is of; raises the problem `bad-token`."""
        known = self._verified.get(token)
        if known is None:
            claims = self._verify(token, "access")
            known = self._verified[token] = claims["sub"], claims["gen"], claims["exp"]
            while len(self._verified) > MOST_VERIFIED:
                del self._verified[next(iter(self._verified))]
        number, generation, until_s = known
        identity = self._identity(number)
        if generation != identity.generation or until_s <= self._wall_s():
            del self._verified[token]
            raise problem("bad-token", "the token has expired or was revoked: get another")
        return identity

    def session_token(self, session: SessionRecord, lease_s: float) -> str:
        """What opens a session on its node, until the lease ends."""
        return self._sign(
            {"sub": session.id, "aud": f"node:{session.node}", "inc": session.incarnation,
             "cfg": session.configuration, "use": "session"},
            lease_s,
        )  # fmt: skip

    def _tokens(self, identity: IdentityRecord) -> dict[str, Any]:
        claims = {"sub": identity.id, "aud": AUDIENCE, "gen": identity.generation}
        return {
            "access_token": self._sign({**claims, "use": "access"}, ACCESS_S),
            "refresh_token": self._sign({**claims, "use": "refresh"}, REFRESH_S),
            "token_type": "Bearer",
            "expires_in": ACCESS_S,
            "role": identity.role,
            "identity": identity.id,
        }

    def _by_secret(self, secret: str) -> IdentityRecord:
        _, _, rest = secret.partition(".")
        identity = self._log.state.identities.get(rest.partition(".")[0])
        known = identity.digest if identity else _digest("")
        if not hmac.compare_digest(known, _digest(secret)) or identity is None or identity.revoked:
            raise problem("bad-token", "the secret is not that of any identity")
        return identity

    def _sign(self, claims: dict[str, Any], lives_s: float) -> str:
        number, key = next(reversed(self._keys.items()))
        now_s = self._wall_s()
        content = {"iss": ISSUER, "iat": now_s, "exp": now_s + lives_s,
                   "jti": secrets.token_hex(12), **claims}  # fmt: skip
        return jwt.encode(content, key, ALGORITHM, headers={"kid": number})

    def _verify(self, token: str, use: str) -> dict[str, Any]:
        try:
            number = jwt.get_unverified_header(token).get("kid")
            key = self._keys[str(number)].public_key()
            claims: dict[str, Any] = jwt.decode(
                token, key, [ALGORITHM], audience=AUDIENCE, issuer=ISSUER,
                options={"require": ["exp", "iat", "sub", "jti"], "verify_exp": False,
                         "verify_iat": False},
            )  # fmt: skip
        except (jwt.InvalidTokenError, KeyError) as error:
            raise problem("bad-token", "the token is not one of this service's") from error
        if claims["exp"] <= self._wall_s():
            raise problem("bad-token", "the token has expired: get another")
        identity = self._log.state.identities.get(claims["sub"])
        is_void = identity is None or identity.revoked or claims.get("gen") != identity.generation
        if claims.get("use") != use or is_void:
            raise problem("bad-token", "the token was revoked, or is of another use")
        return claims

    def _identity(self, number: str) -> IdentityRecord:
        identity = self._log.state.identities.get(number)
        if identity is None:
            raise problem("not-found", f"there is no identity '{number}'")
        return identity

    def _load_keys(self) -> None:
        self._verified.clear()
        newest = list(self._log.state.keys.items())[-KEYS_KEPT:]
        self._keys: dict[str, Ed25519PrivateKey] = {}
        for number, pem in newest:
            key = serialization.load_pem_private_key(pem.encode(), None)
            assert isinstance(key, Ed25519PrivateKey)
            self._keys[number] = key


def _digest(secret: str) -> str:
    """Secrets are random and long: a fast hash cannot be searched."""
    return hashlib.sha256(secret.encode()).hexdigest()
