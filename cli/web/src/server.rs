//! The server: the page, the state, a stream of states, and the hands, on 127.0.0.1 only.
//!
//! Every program and every user of this machine can connect, and so can a page of any site in the
//! user's browser. A request that names another host is refused, so a site cannot make the browser
//! read the state under its own name (DNS rebinding). Neither is a request from another origin
//! served. Orders need the token, which only the terminal shows.

use std::convert::Infallible;
use std::net::{Ipv4Addr, TcpListener};
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::Duration;

use anyhow::Context as _;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{DefaultBodyLimit, Request, State as Shared};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Router, body::Body};
use futures_util::stream::{self, Stream};
use serde::{Deserialize, Serialize};
use tandem_board::SystemId;
use tandem_watch::{Hand, Hands};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot, watch};

use crate::connections::Limited;
use crate::fragments::{Fragments, PlotData, Plots};
use crate::history::History;
use crate::live_page::page;
use crate::state::State;
use crate::token::Token;

/// Most streams at a time. Each costs a connection and the drawing of the page.
const STREAMS_MAX: usize = 16;
/// Most connections at a time: those of the streams, and of a few browsers beside them.
const CONNECTIONS_MAX: usize = 64;
/// A connection without progress ends after this time. A stream says something more often, even if
/// the run does not publish ([`KeepAlive`]: 15 s).
const IDLE: Duration = Duration::from_secs(40);
/// The largest order, bytes.
const ORDER_MAX: usize = 1_024;

/// What the server shows: the newest state, as text.
#[derive(Clone, Debug, Default)]
struct Shown {
    /// JSON of [`State`].
    state: Arc<str>,
    /// JSON of the state and the parts of the page; empty while no stream is open.
    update: Arc<str>,
}

/// An order of a button, on its way to the thread that has the hands.
pub(crate) struct Order {
    hand: Hand,
    on: Target,
    answer: oneshot::Sender<Result<String, String>>,
}

/// On which system a hand acts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Target {
    System(SystemId),
    /// The system that the vehicle obeys when the hand acts.
    Master,
}

impl Order {
    /// Does the work, and answers.
    pub(crate) fn carry_out(self, hands: &mut Hands, history: &mut History) {
        let system = match self.on {
            Target::System(system) => Some(system),
            Target::Master => history.picture.obeyed(),
        };
        let done = match system {
            Some(system) => hands.lay(self.hand, system).map_err(|it| it.to_string()),
            None => Err("the vehicle obeys no system yet".to_owned()),
        };
        let (Ok(said) | Err(said)) = &done;
        history.said.clone_from(said);
        // The client may have gone.
        let _ = self.answer.send(done);
    }
}

/// The body of a request to `/hands`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct OrderText {
    hand: String,
    system: String,
}

/// The body of an answer that is not a page.
#[derive(Debug, Serialize)]
struct Said<'a> {
    said: &'a str,
}

/// What the handlers share.
struct Desk {
    port: u16,
    token: Token,
    shown: watch::Receiver<Shown>,
    /// A permit for each stream.
    streams: Arc<Semaphore>,
    orders: Sender<Order>,
}

/// A running server. It ends with the program.
pub(crate) struct Server {
    port: u16,
    shown: watch::Sender<Shown>,
}

impl Server {
    /// Starts to serve on this port of 127.0.0.1; 0 chooses a free one. Orders with the token go to
    /// `orders`.
    ///
    /// # Errors
    /// If the port is in use, or a thread cannot be started.
    pub(crate) fn start(port: u16, token: Token, orders: Sender<Order>) -> anyhow::Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))
            .with_context(|| format!("--port {port}: 127.0.0.1:{port} cannot be opened"))?;
        listener.set_nonblocking(true).context("a socket")?;
        let port = listener.local_addr().context("a socket")?.port();
        let (shown, receiver) = watch::channel(Shown::default());
        let desk = Desk {
            port,
            token,
            shown: receiver,
            streams: Arc::new(Semaphore::new(STREAMS_MAX)),
            orders,
        };
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .context("the server's loop")?;
        let serve = move || {
            runtime.block_on(async {
                let listener = tokio::net::TcpListener::from_std(listener)?;
                let listener = Limited::new(listener, CONNECTIONS_MAX, IDLE);
                axum::serve(listener, router(Arc::new(desk))).await
            })
        };
        let thread = std::thread::Builder::new().name("server".to_owned());
        thread.spawn(serve).context("a thread for the server")?;
        Ok(Self { port, shown })
    }

    /// Returns the port.
    pub(crate) const fn port(&self) -> u16 {
        self.port
    }

    /// Shows this state from now on.
    pub(crate) fn show(&self, history: &History) {
        let state = State::of(history);
        let text = serde_json::to_string(&state).unwrap_or_default();
        // One receiver is the desk's. Draw only for others.
        let update = match self.shown.receiver_count() > 1 {
            true => update(history),
            false => String::new(),
        };
        self.shown.send_replace(Shown {
            state: text.into(),
            update: update.into(),
        });
    }
}

/// Returns the content of an event.
fn update(history: &History) -> String {
    #[derive(Serialize)]
    struct Update<'a> {
        state: State<'a>,
        parts: Fragments,
        plots: PlotData<'a>,
    }
    let plots = Plots::of(history);
    let update = Update {
        state: State::of(history),
        parts: Fragments::of(history),
        plots: plots.data(),
    };
    serde_json::to_string(&update).unwrap_or_default()
}

fn router(desk: Arc<Desk>) -> Router {
    Router::new()
        .route("/", get(get_page))
        .route("/state", get(get_state))
        .route("/events", get(get_events))
        .route("/hands", post(post_order))
        .layer(DefaultBodyLimit::max(ORDER_MAX))
        .layer(middleware::from_fn_with_state(Arc::clone(&desk), guard))
        .with_state(desk)
}

/// Refuses requests that are not for this server by name, or that another site has caused. Adds
/// the headers that each answer has.
async fn guard(Shared(desk): Shared<Arc<Desk>>, request: Request, next: Next) -> Response {
    let mut response = match refusal(request.headers(), desk.port) {
        Some(reason) => said(StatusCode::FORBIDDEN, reason),
        None => next.run(request).await,
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CACHE_CONTROL, "no-store"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Returns why a request with these headers is refused; `None` if it is not.
fn refusal(headers: &HeaderMap, port: u16) -> Option<&'static str> {
    let own = [format!("127.0.0.1:{port}"), format!("localhost:{port}")];
    let is_own = |value: &HeaderValue, scheme: &str| {
        let host = value.to_str().ok().and_then(|it| it.strip_prefix(scheme));
        host.is_some_and(|host| own.iter().any(|it| it == host))
    };
    let all = |name, scheme| headers.get_all(name).iter().all(|it| is_own(it, scheme));
    if !headers.contains_key(header::HOST) || !all(header::HOST, "") {
        return Some("this server is 127.0.0.1 or localhost, under no other name");
    }
    match all(header::ORIGIN, "http://") {
        true => None,
        false => Some("a page of another site may not use this server"),
    }
}

/// Returns a JSON answer with a text.
fn said(status: StatusCode, text: &str) -> Response {
    let body = serde_json::to_string(&Said { said: text }).unwrap_or_default();
    (status, [(header::CONTENT_TYPE, "application/json")], body).into_response()
}

async fn get_page() -> Response {
    // A new nonce for each answer: text that gets into the page by a mistake cannot know it.
    let Ok(nonce) = Token::new() else {
        return said(StatusCode::INTERNAL_SERVER_ERROR, "no random numbers");
    };
    let nonce = nonce.text();
    let policy = format!(
        "default-src 'none'; style-src 'unsafe-inline'; script-src 'nonce-{nonce}'; \
         connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    );
    let headers = [
        (header::CONTENT_TYPE, "text/html; charset=utf-8".to_owned()),
        (header::CONTENT_SECURITY_POLICY, policy),
    ];
    (headers, page(nonce)).into_response()
}

async fn get_state(Shared(desk): Shared<Arc<Desk>>) -> Response {
    let state = Arc::clone(&desk.shown.borrow().state);
    if state.is_empty() {
        return said(
            StatusCode::SERVICE_UNAVAILABLE,
            "the run does not publish yet",
        );
    }
    let body = Body::from(state.to_string());
    ([(header::CONTENT_TYPE, "application/json")], body).into_response()
}

async fn get_events(Shared(desk): Shared<Arc<Desk>>) -> Response {
    let Ok(permit) = Arc::clone(&desk.streams).try_acquire_owned() else {
        return said(StatusCode::SERVICE_UNAVAILABLE, "too many pages are open");
    };
    let events = Sse::new(events(desk.shown.clone(), permit));
    events.keep_alive(KeepAlive::default()).into_response()
}

/// Returns the newest state whenever it has changed. A slow client misses states in between. The
/// stream keeps the permit.
fn events(
    shown: watch::Receiver<Shown>,
    permit: OwnedSemaphorePermit,
) -> impl Stream<Item = Result<Event, Infallible>> {
    stream::unfold((shown, permit), |(mut shown, permit)| async {
        loop {
            shown.changed().await.ok()?;
            let update = Arc::clone(&shown.borrow_and_update().update);
            if !update.is_empty() {
                return Some((Ok(Event::default().data(&*update)), (shown, permit)));
            }
        }
    })
}

async fn post_order(
    Shared(desk): Shared<Arc<Desk>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let given = { headers.get(header::AUTHORIZATION) }
        .and_then(|value| value.to_str().ok()?.strip_prefix("Bearer "));
    if !given.is_some_and(|given| desk.token.is(given)) {
        return said(
            StatusCode::UNAUTHORIZED,
            "this needs the token that tandem has printed",
        );
    }
    // A form of another site cannot have this type without asking this server first.
    let kind = headers.get(header::CONTENT_TYPE).map(HeaderValue::as_bytes);
    if kind != Some(b"application/json") {
        return said(StatusCode::UNSUPPORTED_MEDIA_TYPE, "send application/json");
    }
    let body = match body {
        Ok(body) => body,
        Err(refused) => return said(refused.status(), &refused.body_text()),
    };
    let (hand, on) = match order(&body) {
        Ok(order) => order,
        Err(why) => return said(StatusCode::UNPROCESSABLE_ENTITY, &why),
    };
    let (answer, answered) = oneshot::channel();
    // Without a run nothing takes orders, and the answer is dropped at the end of the program.
    if desk.shown.borrow().state.is_empty() || desk.orders.send(Order { hand, on, answer }).is_err()
    {
        return said(StatusCode::SERVICE_UNAVAILABLE, "there is no run");
    }
    match answered.await {
        Ok(Ok(begun)) => said(StatusCode::OK, &begun),
        Ok(Err(why)) => said(StatusCode::CONFLICT, &why),
        Err(_) => said(StatusCode::SERVICE_UNAVAILABLE, "the run has ended"),
    }
}

/// Reads an order.
fn order(body: &[u8]) -> Result<(Hand, Target), String> {
    let text: OrderText = serde_json::from_slice(body).map_err(|error| error.to_string())?;
    let hand = Hand::named(&text.hand);
    let names = || Hand::ALL.map(|hand| hand.to_string()).join(", ");
    let hand = hand.ok_or_else(|| format!("hand: it is one of {}", names()))?;
    let on = match text.system.as_str() {
        "master" => Some(Target::Master),
        name => { SystemId::ALL.into_iter() }
            .find(|system| system.to_string() == name)
            .map(Target::System),
    };
    let on = on.ok_or("system: it is A, B or master")?;
    Ok((hand, on))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(header::HeaderName, &'static str)]) -> HeaderMap {
        let pairs = pairs.iter();
        { pairs.map(|(name, value)| (name.clone(), HeaderValue::from_static(value))) }.collect()
    }

    #[test]
    fn other_hosts_and_other_origins_are_refused() {
        let refused = |pairs: &[_]| refusal(&headers(pairs), 4711).is_some();
        assert!(!refused(&[(header::HOST, "127.0.0.1:4711")]));
        assert!(!refused(&[(header::HOST, "localhost:4711")]));
        let own = (header::HOST, "127.0.0.1:4711");
        assert!(!refused(&[
            own.clone(),
            (header::ORIGIN, "http://127.0.0.1:4711")
        ]));
        assert!(refused(&[]));
        for host in [
            "evil.example:4711",
            "127.0.0.1",
            "127.0.0.1:80",
            "127.0.0.1:4711.evil.example",
        ] {
            assert!(refused(&[(header::HOST, host)]), "{host}");
        }
        for origin in [
            "http://evil.example",
            "https://127.0.0.1:4711",
            "null",
            "http://127.0.0.1:80",
        ] {
            assert!(
                refused(&[own.clone(), (header::ORIGIN, origin)]),
                "{origin}"
            );
        }
    }

    #[test]
    fn orders_are_checked() {
        let read = |text: &str| order(text.as_bytes());
        assert_eq!(
            read(r#"{"hand": "kill-supply", "system": "master"}"#),
            Ok((Hand::KillSupply, Target::Master))
        );
        assert_eq!(
            read(r#"{"hand": "cut-can", "system": "B"}"#),
            Ok((Hand::CutCan, Target::System(SystemId::B)))
        );
        for wrong in [
            "",
            "[]",
            r#"{"hand": "kill-supply"}"#,
            r#"{"hand": "kill-core-3", "system": "A"}"#,
            r#"{"hand": "mend", "system": "C"}"#,
            r#"{"hand": "mend", "system": "A", "more": 1}"#,
        ] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }
}
