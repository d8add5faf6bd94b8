from __future__ import annotations

from unittest.mock import MagicMock

from explorer.panels.error_notice import ErrorNotice


def test_an_error_stays_until_the_next_one_or_until_it_is_over() -> None:
    client = MagicMock()
    handles = client.add_notification.side_effect = [MagicMock(), MagicMock()]
    notice = ErrorNotice(client)
    notice.forget()  # there is none
    notice.show("Upload failed", "a.png is damaged")
    assert client.add_notification.call_args.kwargs["auto_close_seconds"] is None
    first, second = handles
    notice.show("Upload failed", "b.png is damaged")
    first.remove.assert_called_once()
    second.remove.assert_not_called()
    notice.forget()
    notice.forget()
    second.remove.assert_called_once()


def test_a_name_in_an_error_holds_no_control_characters() -> None:
    client = MagicMock()
    ErrorNotice(client).show("No\x1b[2J", "\u202egpj.exe is damaged")
    assert client.add_notification.call_args.args == ("No?[2J", "?gpj.exe is damaged")
