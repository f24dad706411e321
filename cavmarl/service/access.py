"""Access control: identities, secrets, tokens and the keys that sign them.

A secret has 256 random bits. It is shown once, and the store keeps only its hash. A client
exchanges it for a bearer token, which lives for minutes, and a refresh token, which can be used
once. Tokens are signed with Ed25519, so nodes verify the tokens of sessions with public keys alone.
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
KEYS_KEPT = 2  # keys whose tokens are accepted: the current and the previous one
MOST_VERIFIED = 10_000  # tokens in the cache of checked signatures
STATE_S = 3600.0  # validity of the signature of a state; exceeds any difference between clocks

Admit = Callable[[str], None]


class Access:
    """The identities, tokens and signing keys of a service, according to its event log."""

    def __init__(self, log: EventLog, wall_s: Callable[[], float] = time.time) -> None:
        self._log = log
        self._wall_s = wall_s
        self._verified: dict[str, tuple[str, int, float]] = {}  # cache of checked signatures
        if not log.state.keys:
            self.rotate_key()
        self._load_keys()

    def add_identity(
        self, name: str, role: Role, actor: str = "service"
    ) -> tuple[IdentityRecord, str]:
        """Create an identity; return it and its secret, which cannot be shown again."""
        there = [one for one in self._log.state.identities.values() if one.name == name]
        if any(not one.revoked for one in there):
            raise problem("conflict", f"identity '{name}' exists already: choose another name")
        number = f"id-{secrets.token_hex(8)}"
        secret = f"cav.{number}.{secrets.token_urlsafe(32)}"
        data, private = {"name": name, "role": role}, {"digest": _digest(secret)}
        self._log.record("identity.added", number, data, actor=actor, private=private)
        return self._log.state.identities[number], secret

    def revoke(self, number: str, actor: str) -> None:
        """Revoke an identity, its secret and all its tokens."""
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
        """Create a new signing key and return its id."""
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
        """Return the keys that verify tokens, as a JSON Web Key Set."""
        keys = []
        for number, key in self._keys.items():
            found = json.loads(OKPAlgorithm.to_jwk(key.public_key()))
            keys.append({**found, "kid": number, "alg": ALGORITHM, "use": "sig"})
        return {"keys": keys}

    def exchange(self, secret: str, admit: Admit = lambda _: None) -> dict[str, Any]:
        """Return tokens for a secret.

        Args:
            secret: as `add_identity` returned it.
            admit: called first, with the id of the identity; may raise an error.
        """
        identity = self._by_secret(secret)
        admit(identity.id)
        return self._tokens(identity)

    def refresh(self, refresh_token: str, admit: Admit = lambda _: None) -> dict[str, Any]:
        """Return new tokens for an unused refresh token; for `admit`, see `exchange`."""
        claims = self._verify(refresh_token, "refresh")
        identity = self._identity(claims["sub"])
        admit(identity.id)
        if claims["jti"] in identity.used:  # the token, or the answer to its first use, was stolen
            self._log.record("identity.withdrawn", identity.id)
            raise problem(
                "bad-token",
                "the refresh token was used before; all tokens of the identity are revoked",
            )
        data = {"token": claims["jti"], "expires_s": claims["exp"]}
        self._log.record("identity.refreshed", identity.id, data, actor=identity.id)
        return self._tokens(identity)

    def withdraw(self, identity: IdentityRecord) -> None:
        """Revoke all tokens of an identity; its secret stays valid."""
        self._log.record("identity.withdrawn", identity.id, actor=identity.id)

    def authenticate(self, token: str) -> IdentityRecord:
        """Return the identity of an access token; raise the problem `bad-token` if invalid."""
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
            raise problem("bad-token", "the token has expired or was revoked: get another token")
        return identity

    def session_token(self, session: SessionRecord, lease_s: float) -> str:
        """Return a token that opens a session on its node until the lease ends."""
        return self._sign(
            {"sub": session.id, "aud": f"node:{session.node}", "inc": session.incarnation,
             "cfg": session.configuration, "use": "session"},
            lease_s,
        )  # fmt: skip

    def state_token(self, session: SessionRecord, number: int, content: bytes) -> str:
        """Return the service's signature of a saved state, valid only for the node of its session.

        Nodes check it with public keys, so no node can sign a state itself.
        """
        return self._sign(
            {"sub": session.id, "aud": f"node:{session.node}", "number": number,
             "sha256": hashlib.sha256(content).hexdigest(), "use": "state"},
            STATE_S,
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
            raise problem("bad-token", "the secret belongs to no identity")
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
            raise problem("bad-token", "the token was not issued by this service") from error
        if claims["exp"] <= self._wall_s():
            raise problem("bad-token", "the token has expired: get another")
        identity = self._log.state.identities.get(claims["sub"])
        is_void = identity is None or identity.revoked or claims.get("gen") != identity.generation
        if claims.get("use") != use or is_void:
            raise problem("bad-token", "the token was revoked, or has another purpose")
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
    """Return the hash of a secret; a fast hash is enough, as secrets are long and random."""
    return hashlib.sha256(secret.encode()).hexdigest()
