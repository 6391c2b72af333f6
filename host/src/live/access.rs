//! Who may ask: no page of another site may read the map or command the robot through a browser on this computer.
//!
//! A request must name as its host an address, `localhost`, or a name that was allowed. A site whose name is made to lead here
//! (DNS rebinding) names itself, and is refused. A WebSocket must besides come from a page of this very server: its `Origin` is
//! `http://` and what it names as its host.

use std::net::{IpAddr, Ipv6Addr};

use axum::http::HeaderMap;
use axum::http::header::{HOST, ORIGIN};

/// Names by which the server may be asked.
#[derive(Clone, Debug)]
pub struct Access {
    /// Only this computer can reach it.
    pub loopback: bool,
    /// Names besides addresses and `localhost`.
    pub names: Vec<String>,
}

/// Why a request was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// It names no host, or one that may not be asked for.
    #[error("this server does not go by the name '{0}': open it by its address, or start it with --host {0}")]
    Host(String),
    /// It comes from a page of another site.
    #[error("the page at '{0}' is not of this server")]
    Origin(String),
}

impl Access {
    /// Checks the host of any request.
    pub fn check_host(&self, headers: &HeaderMap) -> Result<(), Refused> {
        let host = only(headers, HOST.as_str());
        let name = host.and_then(without_port).filter(|name| self.goes_by(name));
        name.map(|_| ()).ok_or_else(|| Refused::Host(shown(host)))
    }

    /// Checks the origin of a WebSocket as well.
    pub fn check_origin(&self, headers: &HeaderMap) -> Result<(), Refused> {
        self.check_host(headers)?;
        let origin = only(headers, ORIGIN.as_str());
        let own = only(headers, HOST.as_str()).is_some_and(|host| {
            origin
                .and_then(|origin| origin.strip_prefix("http://"))
                .is_some_and(|of| of.eq_ignore_ascii_case(host))
        });
        if own { Ok(()) } else { Err(Refused::Origin(shown(origin))) }
    }

    fn goes_by(&self, name: &str) -> bool {
        let bare = name.strip_prefix('[').and_then(|name| name.strip_suffix(']'));
        let address = match bare {
            Some(bare) => bare.parse::<Ipv6Addr>().ok().map(IpAddr::V6),
            None => name.parse::<IpAddr>().ok().filter(IpAddr::is_ipv4),
        };
        match address {
            Some(address) => !self.loopback || address.is_loopback(),
            None => {
                name.eq_ignore_ascii_case("localhost")
                    || self.names.iter().any(|own| own.eq_ignore_ascii_case(name))
            }
        }
    }
}

/// The value of a header that is there once.
fn only<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    let mut values = headers.get_all(name).iter();
    let value = values.next()?.to_str().ok()?;
    values.next().is_none().then_some(value)
}

fn without_port(host: &str) -> Option<&str> {
    let end = host.rfind(']').map_or(0, |bracket| bracket + 1);
    match host[end..].rfind(':') {
        Some(colon) => {
            let (name, port) = host.split_at(end + colon);
            port[1..].parse::<u16>().is_ok().then_some(name)
        }
        None => Some(host),
    }
}

/// For a message: short, and printable.
fn shown(value: Option<&str>) -> String {
    value.unwrap_or_default().chars().filter(char::is_ascii_graphic).take(80).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    fn headers(host: &str, origin: Option<&str>) -> HeaderMap {
        let mut headers = HeaderMap::new();
        headers.insert(HOST, HeaderValue::from_str(host).unwrap());
        if let Some(origin) = origin {
            headers.insert(ORIGIN, HeaderValue::from_str(origin).unwrap());
        }
        headers
    }

    #[test]
    fn hosts_by_address_and_known_names_only() {
        let own = Access { loopback: true, names: vec![] };
        for host in
            ["127.0.0.1:8017", "localhost:8017", "LOCALHOST", "[::1]:8017", "127.0.0.1", "localhost:9000"]
        {
            assert_eq!(own.check_host(&headers(host, None)), Ok(()), "{host}");
        }
        for host in [
            "evil.example:8017",
            "192.168.1.4:8017",
            "127.0.0.1.evil.example",
            "localhost:x",
            "",
            "::1",
            "localhost.evil.example",
            "[127.0.0.1]:80",
        ] {
            assert!(own.check_host(&headers(host, None)).is_err(), "{host}");
        }
        let open = Access { loopback: false, names: vec!["robot.local".into()] };
        for host in ["192.168.1.4:8017", "robot.local:8017", "[fe80::1]:8017"] {
            assert_eq!(open.check_host(&headers(host, None)), Ok(()), "{host}");
        }
        assert!(open.check_host(&headers("evil.example:8017", None)).is_err());
        assert!(own.check_host(&HeaderMap::new()).is_err(), "no host at all");
        let mut twice = headers("localhost", None);
        twice.append(HOST, HeaderValue::from_static("localhost"));
        assert!(own.check_host(&twice).is_err(), "two hosts");
    }

    #[test]
    fn web_sockets_from_the_own_origin_only() {
        let own = Access { loopback: true, names: vec![] };
        let check = |host: &str, origin: Option<&str>| own.check_origin(&headers(host, origin));
        assert_eq!(check("127.0.0.1:8017", Some("http://127.0.0.1:8017")), Ok(()));
        assert_eq!(check("localhost:8017", Some("http://localhost:8017")), Ok(()));
        let foreign = [
            Some("http://evil.example"),
            Some("http://localhost:8017"),
            Some("http://127.0.0.1:3000"),
            Some("https://127.0.0.1:8017"),
            Some("http://127.0.0.1:8017.evil.example"),
            Some("null"),
            Some(""),
            None,
        ];
        for origin in foreign {
            assert!(matches!(check("127.0.0.1:8017", origin), Err(Refused::Origin(_))), "{origin:?}");
        }
        let rebound = check("evil.example:8017", Some("http://evil.example:8017"));
        assert_eq!(rebound, Err(Refused::Host("evil.example:8017".into())));
    }
}
