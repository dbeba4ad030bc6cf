// Threads that wait for work a moment awake and then asleep.
//
// Whoever calls takes shares of the work itself until none is left, and waits only for those that others have
// begun: on a busy machine, where a thread wakes late, nobody waits for it to begin.
#include "threads.h"

#include <pthread.h>
#include <signal.h>

#include <chrono>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>

namespace vlgs {
namespace {

// The kernels of one call follow each other within microseconds, calls of Python within tens of them: to wake
// a thread takes as long.
constexpr std::chrono::microseconds kAwake{50};
constexpr int kPauses = 64;  // between two looks at the clock

inline void pause() {
#if defined(__x86_64__) || defined(__i386__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

// Waits for a moment at most; whether it came true. Whoever else wants the core gets it.
template <class Condition>
bool awaited(const Condition &condition) {
  const auto end = std::chrono::steady_clock::now() + kAwake;
  do {
    for (int i = 0; i < kPauses; ++i) {
      if (condition()) return true;
      pause();
    }
    std::this_thread::yield();
  } while (std::chrono::steady_clock::now() < end);
  return condition();
}

// One call of run_shares; it lies on the stack of whoever made it. What changes does so under the lock of the
// pool, but for the share to take.
struct Job {
  int shares;
  DoShare do_share;
  const void *work;
  std::atomic<int> next = 0;     // share to take
  std::atomic<int> helpers = 0;  // threads of the pool that are at it
  std::exception_ptr error = nullptr;
  Job *after = nullptr;  // in the list of the pool
};

class Pool {
 public:
  void run(Job &job) {
    post(job);
    take_shares(job);
    withdraw(job);
    if (job.error) std::rethrow_exception(job.error);
  }

 private:
  void post(Job &job) {
    int wake;
    {
      const std::lock_guard guard(lock_);
      while (threads_ < job.shares - 1 && start_thread()) ++threads_;
      job.after = jobs_;
      jobs_ = &job;
      posted_.fetch_add(1);
      wake = std::min(asleep_, job.shares - 1);
    }
    for (; wake > 0; --wake) work_.notify_one();
  }

  // From the list, and waits for those who help.
  void withdraw(Job &job) {
    {
      const std::lock_guard guard(lock_);
      Job **at = &jobs_;
      while (*at != &job) at = &(*at)->after;
      *at = job.after;
    }
    const auto alone = [&job] { return job.helpers == 0; };
    if (awaited(alone)) return;
    std::unique_lock guard(lock_);
    done_.wait(guard, alone);
  }

  void take_shares(Job &job) {
    try {
      for (int s; (s = job.next.fetch_add(1)) < job.shares;) job.do_share(job.work, s);
    } catch (...) {
      job.next = job.shares;
      const std::lock_guard guard(lock_);
      if (!job.error) job.error = std::current_exception();
    }
  }

  // Whether the system has one more; without it the work takes longer, and that is all.
  bool start_thread() {
    // Signals are Python's; those that a thread brings upon itself stay its own.
    sigset_t most, before;
    sigfillset(&most);
    for (const int own : {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGTRAP}) sigdelset(&most, own);
    pthread_sigmask(SIG_SETMASK, &most, &before);
    bool started = true;
    try {
      std::thread([this] { help(); }).detach();
    } catch (const std::system_error &) {
      started = false;
    }
    pthread_sigmask(SIG_SETMASK, &before, nullptr);
    return started;
  }

  [[noreturn]] void help() {
    std::unique_lock guard(lock_);
    for (;;) {
      if (Job *const job = open_job()) {
        job->helpers.fetch_add(1);
        guard.unlock();
        take_shares(*job);
        guard.lock();
        if (job->helpers.fetch_sub(1) == 1) done_.notify_all();
        continue;
      }
      const int seen = posted_;
      guard.unlock();
      const bool more = awaited([&] { return posted_ != seen; });
      guard.lock();
      if (more || posted_ != seen) continue;
      ++asleep_;
      work_.wait(guard);
      --asleep_;
    }
  }

  Job *open_job() const {
    Job *job = jobs_;
    while (job && job->next >= job->shares) job = job->after;
    return job;
  }

  std::mutex lock_;
  std::condition_variable work_, done_;
  Job *jobs_ = nullptr;  // newest first
  std::atomic<int> posted_ = 0;
  int threads_ = 0, asleep_ = 0;
};

std::atomic<Pool *> current = nullptr;

// Never destroyed: its threads wait in it while the process ends. A child process has no threads of its
// parent's, and makes a pool of its own when it needs one.
Pool &pool() {
  static const int registered = pthread_atfork(nullptr, nullptr, [] { current = nullptr; });
  (void)registered;
  Pool *there = current;
  if (there) return *there;
  Pool *const made = new Pool;
  if (current.compare_exchange_strong(there, made)) return *made;
  delete made;
  return *there;
}

}  // namespace

void run_shares(int shares, DoShare do_share, const void *work) {
  Job job{shares, do_share, work};
  pool().run(job);
}

}  // namespace vlgs
